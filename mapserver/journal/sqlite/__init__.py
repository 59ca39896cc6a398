"""The journal of one server: a SQLite file in the folder of its store."""
