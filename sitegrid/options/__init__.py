"""Shared options, and types of option values."""
