"""Position accuracy: the paper's table."""
