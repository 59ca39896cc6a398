"""Simulation: machines on a terrain, their sensors and the ground truth. Not imported at run time."""
