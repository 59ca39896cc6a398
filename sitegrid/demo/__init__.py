"""The demo: router, map server, simulator and agents on one host, each its own process."""
