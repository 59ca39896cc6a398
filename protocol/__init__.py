"""What machines, map server and clients share: readings, samples, messages, keys, queries, coordinates, errors."""
