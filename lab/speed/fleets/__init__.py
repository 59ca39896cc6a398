"""Whole fleets at a real server: what ingest takes, and what readers and followers cost it."""
