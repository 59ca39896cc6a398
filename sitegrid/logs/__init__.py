"""Recordings of real machines: what of one is usable, its positions and ground, and how far they are off."""
