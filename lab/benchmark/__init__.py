"""A benchmark that others can enter: recordings with truth, rules, baselines, and the table (lab/benchmark/README.md)."""
