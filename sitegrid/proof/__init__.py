"""Scores of what was simulated: samples delivered, maps and positions against the truth."""
