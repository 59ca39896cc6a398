"""Speed, measured: `python -m benchmarks merge` (fold kernels) and `ingest` (bytes to disk to grid).

Each prints a small table, or with `--json` one JSON object; `--samples` makes a run longer or shorter. Figures of a
shared machine scatter: variants are measured in turn within one run and given as medians, so trust their ratios.
"""
