"""Scenarios: files, tables, and their ground."""
