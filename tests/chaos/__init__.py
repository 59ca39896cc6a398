"""Fault suite: real processes, real faults, counts of lost and double samples (docs/guarantees.md)."""
