"""Measure what sitegrid achieves.

The commands of `python -m lab`, one module each, as those of `sitegrid`.
"""
