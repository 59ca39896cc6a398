"""Speed, measured: `python -m lab speed LOAD`; `--help` lists the loads.

Each prints one table, or with `--json` one JSON object: a row per case and figure. Figures of a shared machine scatter:
variants run in turn within one measurement and are given as medians, so trust their ratios.
"""
