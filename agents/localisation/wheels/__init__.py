"""Wheel sensors on trial: stretches beside receivers, and verdicts."""
