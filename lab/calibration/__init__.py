"""Calibration of machines by each other and by the ground: benefit to the map, and harmlessness."""
