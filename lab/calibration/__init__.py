"""Calibration of machines by each other and by the ground: what it gives the map, and where it must do no harm."""
