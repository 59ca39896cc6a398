"""Samples from the machine's own disk to the map server: spool, uplink, and the audit of both."""
