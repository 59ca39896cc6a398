"""Speed measurements: `python -m lab speed LOAD`; `--help` lists the loads.

Output: a table, or one JSON object with `--json`: a row per case and figure. A shared host makes figures scatter:
variants run in turn within one measurement, medians are given; trust their ratios.
"""
