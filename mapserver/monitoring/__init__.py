"""The server in numbers, for Prometheus: what it collects, HTTP."""
