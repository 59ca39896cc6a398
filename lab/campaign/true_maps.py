"""True maps as map server answers; pooled scores."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from protocol.arrays import AnyArray, Floats32
from protocol.queries.answers import MapVersion, Region
from protocol.site.geometry import CellWindow
from sim.truth import TruthMap
from sitegrid.proof.figures import Row


def window_of(truth: TruthMap) -> CellWindow:
    """Cells of a true map."""
    rows, columns = truth.c_rr.shape
    return CellWindow(round(truth.west_m / truth.cell_m), round(truth.south_m / truth.cell_m), columns, rows)


def region_of(truth: TruthMap, layers: Mapping[str, AnyArray]) -> Region:
    """Layers on a true map's cells, as a map server's answer."""
    rows, columns = truth.c_rr.shape
    x_m, y_m = (
        np.asarray(corner_m + (np.arange(n) + 0.5) * truth.cell_m, np.float64)
        for corner_m, n in ((truth.west_m, columns), (truth.south_m, rows))
    )
    shown = {name: np.asarray(values, np.float32) for name, values in layers.items()}
    return Region(x_m, y_m, truth.cell_m, shown, MapVersion("", 0, 0), 0)


def true_layers(truth: TruthMap) -> dict[str, Floats32]:
    """A true map's layers by name."""
    return {"resistance": truth.c_rr, "grade_east": truth.grade_east, "grade_north": truth.grade_north}


def pooled_by_border(seeds: Sequence[Sequence[Row]]) -> list[Row]:
    """Pool distance bins (`by_border_distance`) of several seeds."""
    return [_pooled(bins) for bins in zip(*seeds, strict=True)]


def _pooled(bins: Sequence[Row]) -> Row:
    known = np.array([row["cells"] * row["known_pct"] / 100 if row["cells"] else 0.0 for row in bins])
    wrong = np.array([row["wrong_pct"] if n else 0.0 for row, n in zip(bins, known, strict=True)])
    cells = sum(row["cells"] for row in bins)
    return {
        "from_m": bins[0]["from_m"],
        "to_m": bins[0]["to_m"],
        "cells": cells,
        "known_pct": 100 * float(known.sum()) / cells if cells else np.nan,
        "wrong_pct": float((known * wrong).sum() / known.sum()) if known.sum() else np.nan,
    }
