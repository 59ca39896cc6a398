"""A public benchmark: recordings with truth, rules (README.md), baselines, table."""
