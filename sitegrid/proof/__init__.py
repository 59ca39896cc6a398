"""Scores of simulations: delivery of samples, errors of maps and positions."""
