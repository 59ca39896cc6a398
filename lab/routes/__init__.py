"""Accuracy of routes against work truly spent, and of cheapest ways against a finer search."""
