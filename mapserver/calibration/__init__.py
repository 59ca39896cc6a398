"""Calibration of a site's machines by each other and the ground."""
