"""Queries of a real server: how soon they are answered, and what many clients cost the machines."""
