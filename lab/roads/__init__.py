"""Accuracy of roads, traffic and the worklist, on a haul road with random patches of soil."""
