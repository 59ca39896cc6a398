"""Measure what sitegrid achieves.

The commands of `python -m lab`, one module each, as those of `sitegrid`. A module has HELP, EXTRA, add_options and run;
experiments are imported in `run`, so that the help needs none of their libraries.
"""
