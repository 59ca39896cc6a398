"""Zenoh traffic: key expressions, messages, bytes, sessions."""
