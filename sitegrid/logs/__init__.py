"""Recordings of real machines: usability, positions, ground, and errors of both."""
