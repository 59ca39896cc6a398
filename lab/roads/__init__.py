"""Accuracy of roads, traffic and worklist on a haul road with random soil patches."""
