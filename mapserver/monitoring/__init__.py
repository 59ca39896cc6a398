"""The server's metrics for Prometheus: collector and HTTP."""
