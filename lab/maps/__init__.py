"""Accuracy of merged maps by method and case."""
