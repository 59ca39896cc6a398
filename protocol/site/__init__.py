"""The site: frame, grid, kinds of ground."""
