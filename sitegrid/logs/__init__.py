"""What a recording of a real machine shows: whether it can be used, positions, and how far they are off."""
