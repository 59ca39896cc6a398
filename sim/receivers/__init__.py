"""Receivers of simulated machines: what they measure as the bytes that real ones send, on ports that programs open."""
