"""Map queries answered: views of the grid or of the past, and the layers read from them."""
