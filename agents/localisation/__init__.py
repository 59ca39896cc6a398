"""Localisation: poses of the machine with their covariance, from GPS, IMUs and wheels."""
