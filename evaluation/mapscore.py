"""How right a map is: the paper's J, the share of known cells whose class differs from the truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapserver.plotter import Layers
from protocol.ground import resistance_class, slope_class, wrong_percent
from protocol.queries import Region


@dataclass(frozen=True)
class MapScore:
    """Known cells, and the percentage of them that are wrong (NaN where none is known)."""

    cells: int
    wrong_resistance_pct: float
    wrong_grade_pct: float


def score(region: Region, truth: Layers) -> MapScore:
    """Compare a map with true layers of the same cells (resistance, grade_east, grade_north)."""
    found = resistance_class(region["resistance"])
    slope = slope_class(region["grade_east"], region["grade_north"])
    return MapScore(
        cells=int(np.isfinite(region["resistance"]).sum()),
        wrong_resistance_pct=wrong_percent(found, resistance_class(truth["resistance"])),
        wrong_grade_pct=wrong_percent(slope, slope_class(truth["grade_east"], truth["grade_north"])),
    )
