"""Accuracy of ground estimation along one machine's track."""
