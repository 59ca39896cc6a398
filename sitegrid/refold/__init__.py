"""Fold archives again into a new store: sources, selection, workers."""
