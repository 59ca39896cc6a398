"""The journal of one server: a SQLite file in its store."""
