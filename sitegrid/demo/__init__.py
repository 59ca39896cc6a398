"""The demo: router, map server, simulator and agents on one host, a process each."""
