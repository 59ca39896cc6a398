"""What a release is tried with: stores of earlier ones, its packages, its images, and another Python."""
