"""Lanes: where all machines drove, and how it slopes, laid under what this one drove, is a measurement of its place."""
