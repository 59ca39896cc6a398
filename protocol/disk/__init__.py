"""Whether a SQLite database on disk still has all that was committed to it."""
