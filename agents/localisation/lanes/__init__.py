"""Lanes: where all machines drove, laid under what this one drove, is a measurement of its place."""
