"""Scenarios: their files, their tables, and the ground that they describe."""
