"""How right merged maps are, by method and case."""
