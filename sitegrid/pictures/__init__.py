"""Map pictures for the commands `plot` and `demo`."""
