"""What machines sent, on disk: the journal, its archive, and both read as one history."""
