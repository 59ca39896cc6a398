"""Whether a SQLite database still has all its commits."""
