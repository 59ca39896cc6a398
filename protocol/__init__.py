"""Shared by machines, map server and clients: readings, samples, messages, keys, queries, coordinates, errors."""
