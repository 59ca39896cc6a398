"""Accuracy experiments and proofs: maps against truth, journals against audits, real logs."""
