"""Calibration of all machines of a site by each other and by the ground: zero, scale and lateral zero of each."""
