"""The map over HTTP: live page, API resources, tiles, features."""
