"""Experiments as tasks on recordings, worked off on all cores, each result kept."""
