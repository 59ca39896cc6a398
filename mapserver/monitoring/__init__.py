"""The server in numbers, for Prometheus: what it collects, agents' health, HTTP."""
