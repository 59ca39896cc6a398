"""How right the maps of a simulated case are: figures on the cells that machines truly passed."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from evaluation.maps.cases import CELL_M, MapCase, parking_place
from evaluation.maps.methods import Layers
from evaluation.maps.samples import MapScene
from protocol.arrays import Bools, Ints
from protocol.site.ground_classes import UNKNOWN, resistance_class, wrong_percent

GRADE_TOLERANCE = 0.01  # [m/m]; a gradient vector that is off by more is wrong
SHARE = 0.6  # of votes: cells that are surer than this should hardly ever be wrong
NEAR_M = 4.0  # three standard deviations: what the stated positions of a parked machine reach


@dataclass(frozen=True)
class MapFigures:
    """How right a map is, in percent of cells; None where a figure does not apply or nothing was to be judged.

    wrong_pct: of the known cells. known_pct: of the driven ones. changed_wrong_pct, unchanged_wrong_pct: of the repaved
    zone, and of the rest. near_wrong_pct: near a parked machine. share60_wrong_pct: of the cells whose leading class
    has at least SHARE of the votes; share60_cells_pct: how many those are. seconds: processor time of the method.
    """

    wrong_pct: float | None = None
    known_pct: float | None = None
    changed_wrong_pct: float | None = None
    unchanged_wrong_pct: float | None = None
    near_wrong_pct: float | None = None
    share60_wrong_pct: float | None = None
    share60_cells_pct: float | None = None
    seconds: float | None = None


def figures(case: MapCase, scene: MapScene, layers: Layers, seconds: float | None = None) -> MapFigures:
    """Compare a map with the truth, on the cells that machines truly passed and that the case judges."""
    judged = scene.driven & scene.site.judged
    estimated, true = classes(case, scene, layers)

    def wrong(which: Bools) -> float:
        return wrong_percent(estimated[judged & which], true[judged & which])

    values = {"wrong_pct": wrong(np.ones_like(judged)), "known_pct": _percent(estimated[judged] != UNKNOWN)}
    if case.passes_after is not None:
        values |= {"changed_wrong_pct": wrong(scene.site.repaved), "unchanged_wrong_pct": wrong(~scene.site.repaved)}
    if any(machine.parked for machine in case.machines):
        values["near_wrong_pct"] = wrong(near_parked(case))
    if "confidence" in layers and not case.judges_grade:
        sure = layers["confidence"] >= SHARE
        cells = _percent(sure[judged & (estimated != UNKNOWN)])
        values |= {"share60_wrong_pct": wrong(sure), "share60_cells_pct": cells}
    return MapFigures(**{name: value for name, value in values.items() if math.isfinite(value)}, seconds=seconds)


def classes(case: MapCase, scene: MapScene, layers: Layers) -> tuple[Ints, Ints]:
    """Class of each cell in a map and in truth (rows, columns); for gradients, 0 is right and 1 is off by too much."""
    if not case.judges_grade:
        return resistance_class(layers["resistance"]), resistance_class(scene.site.c_rr_later)
    east, north = np.moveaxis(scene.site.gradient, -1, 0)
    off = np.hypot(layers["grade_east"] - east, layers["grade_north"] - north)
    estimated = np.where(np.isfinite(off), off > GRADE_TOLERANCE, UNKNOWN).astype(np.int64)
    return estimated, np.zeros_like(estimated)


def near_parked(case: MapCase) -> Bools:
    """Cells (rows, columns) that the stated positions of parked machines reach."""
    near: Bools = np.zeros((case.rows, case.columns), np.bool_)
    x_m, y_m = ((np.arange(count) + 0.5) * CELL_M for count in (case.columns, case.rows))
    east, north = parking_place(case)
    for machine in case.machines:
        if machine.parked:
            near |= np.hypot(x_m - east - machine.offset_m, y_m[:, None] - north) < NEAR_M
    return near


def _percent(which: Bools) -> float:
    return 100.0 * float(which.mean()) if which.size else math.nan
