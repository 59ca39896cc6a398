"""A benchmark that others can enter: recordings with truth, rules (README.md), baselines, and the table."""
