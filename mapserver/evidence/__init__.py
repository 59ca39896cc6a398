"""What samples become: votes per cell, packed pages of blocks over time, and the grid of all of them."""
