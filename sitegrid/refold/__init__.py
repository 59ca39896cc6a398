"""Archives folded again into a new store: what they hold, which samples of it count, and who does the work."""
