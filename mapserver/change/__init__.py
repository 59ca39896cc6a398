"""Contradictions of recent and older evidence, and their log."""
