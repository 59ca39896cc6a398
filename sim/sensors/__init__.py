"""Sensor models: readings of a true state with their errors, and the sensors of each machine."""
