"""How right the estimate of the ground is, along the way of one machine."""
