"""Recording and replay of a running site."""
