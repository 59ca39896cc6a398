"""Measure what sitegrid achieves.

Commands of `python -m lab`, like those of `sitegrid`: HELP, EXTRA, add_options, run. Experiments are imported in `run`,
so that help needs none of their libraries.
"""
