"""Samples from the machine's own disk to the map server: spool, uplink, its link over Zenoh, and an audit."""
