"""Accuracy of routes against what machines truly spent, and of cheapest ways against a finer search and the truth."""
