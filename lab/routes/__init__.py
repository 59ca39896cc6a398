"""Accuracy of routes against true work, and of cheapest ways against a finer search."""
