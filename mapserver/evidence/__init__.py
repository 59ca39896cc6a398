"""Evidence: votes per cell, packed pages of blocks by time, and the grid of them."""
