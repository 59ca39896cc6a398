"""The site: its frame, its grid of cells, and the kinds of ground."""
