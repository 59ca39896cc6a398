"""The true map of a simulation, cut to the cells of a region."""

from __future__ import annotations

import numpy as np

from protocol.arrays import Floats32
from protocol.errors import ConfigError
from protocol.queries.answers import Region
from sim.truth import TruthMap


def truth_layers(truth: TruthMap, region: Region) -> dict[str, Floats32]:
    """True layers on the cells of a region, NaN beyond the simulated site."""
    if abs(truth.cell_m - region.cell_m) > 1e-9:
        raise ConfigError("--truth", f"has cells of {truth.cell_m:g} m, the map of {region.cell_m:g} m")
    column = round((region.bounds.west_m - truth.west_m) / truth.cell_m)
    row = round((region.bounds.south_m - truth.south_m) / truth.cell_m)
    layers = {"resistance": truth.c_rr, "grade_east": truth.grade_east, "grade_north": truth.grade_north}
    return {name: _cut(values, row, column, region[next(iter(region.layers))].shape) for name, values in layers.items()}


def _cut(values: Floats32, row: int, column: int, shape: tuple[int, ...]) -> Floats32:
    out = np.full(shape, np.nan, np.float32)
    top, left = max(0, -row), max(0, -column)
    bottom, right = min(shape[0], values.shape[0] - row), min(shape[1], values.shape[1] - column)
    if bottom > top and right > left:
        out[top:bottom, left:right] = values[row + top : row + bottom, column + left : column + right]
    return out
