"""What the ground is like: attitude, rolling resistance and gradient from what a machine can measure."""
