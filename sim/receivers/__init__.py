"""Receivers of simulated machines: measurements as the bytes of real receivers, on ports."""
