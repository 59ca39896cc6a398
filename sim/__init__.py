"""Simulation: machines on a terrain, their sensors and their truth; nothing at run time imports it."""
