"""What machines sent, on disk: the journal, its archive, and both as one history."""
