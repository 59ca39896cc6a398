"""Costs of a drive over the map, and the line of least cost."""
