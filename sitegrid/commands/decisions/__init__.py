"""Commands for persistent decisions about a map server's data."""
