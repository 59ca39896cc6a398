"""Speed, measured: `python -m lab.speed NAME`; `--help` lists them.

Each prints small tables, or with `--json` one JSON object; `--samples` and the like make a run longer or shorter.
Figures of a shared machine scatter: variants are measured in turn within one run and given as medians, so trust their
ratios.
"""
