"""Answers to map queries: views of the grid or the past, and layers read from them."""
