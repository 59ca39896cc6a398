"""The server in numbers, for Prometheus."""
