"""Positions without GPS: blackouts, receivers that come back wrong, drives from a start alone."""
