"""Shared by experiments: recordings, parallel tasks with cached results, goals, result pages."""
