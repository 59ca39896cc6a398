"""Recordings of a running site, and their replay."""
