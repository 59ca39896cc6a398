"""The web server, as people and tools meet it."""
