"""Sensor models with their errors, and the sensors of each machine."""
