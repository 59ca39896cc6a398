"""How right positions are: the paper's table."""
