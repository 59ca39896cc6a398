"""Accuracy of merged maps: all methods on the same samples of every case.

Figures cover truly passed, judged cells.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np

from lab.campaign.experiment import Experiment, Runner, Task
from lab.campaign.figures import judge
from lab.campaign.goals import goals
from lab.maps.cases import CASES, CELL_M, MapCase, parking_place
from lab.maps.methods import METHODS, Layers, in_order, merge_hard, soft_votes
from lab.maps.samples import LANE_M, SPEED_MPS, MapScene, simulate
from protocol.arrays import Bools, Ints
from protocol.site.geometry import CellWindow
from protocol.site.ground_classes import UNKNOWN, resistance_class, wrong_percent
from sitegrid.proof.figures import Report, Row, rounded

SERVER = "soft_votes"
RESISTANCE, GRADE = ("resistance",), ("grade_east", "grade_north")
GRADE_TOLERANCE = 0.01  # [m/m]; larger gradient errors count as wrong
SHARE = 0.6  # of votes: surer cells should hardly ever be wrong
NEAR_M = 4.0  # three standard deviations: reach of a parked machine's stated positions
DIGITS = 4  # one cell is 0.0017 %
# Percent of cells; `seconds`: the method's CPU time.
FIGURES = (
    "wrong_pct",  # of known cells
    "known_pct",  # of driven cells
    "changed_wrong_pct",  # in the repaved zone
    "unchanged_wrong_pct",  # elsewhere
    "near_wrong_pct",  # near a parked machine
    "share60_wrong_pct",  # of cells whose leading class has SHARE of the votes
    "share60_cells_pct",  # their number
    "seconds",
)
GOALS = goals("maps")
Output = TypeVar("Output")


@dataclass(frozen=True)
class CaseResult:
    """Result of a task. samples: sent. cells: judged. distrusted: excluded machines.

    methods: FIGURES by method.
    """

    samples: int
    cells: int
    distrusted: list[str]
    methods: dict[str, Row]


def run(runner: Runner, seeds: Sequence[int], cases: Sequence[MapCase] = CASES) -> tuple[Report, list[CaseResult]]:
    """Simulate, merge and judge all cases and seeds."""
    tasks = [Task(case, seed, driven_s(case)) for case in cases for seed in seeds]
    results = runner.run(EXPERIMENT, tasks)
    rows = []
    for i, case in enumerate(cases):
        by_seed = results[i * len(seeds) : (i + 1) * len(seeds)]
        rows += [summarise(case, method, by_seed) for method in (SERVER, *METHODS)]
    return {"seeds": list(seeds), "rows": rows, "goals": judge(GOALS, rows)}, results


def driven_s(case: MapCase) -> float:
    """Total driving time of all machines."""
    passes = sum(machine.passes for machine in case.machines if not machine.parked)
    return passes * case.columns * case.rows * CELL_M**2 / LANE_M / SPEED_MPS


def summarise(case: MapCase, method: str, results: Sequence[CaseResult]) -> Row:
    """A table row: medians over seeds, best, worst, and all seeds.

    distrusted: seeds in which the server excluded each machine; None for other methods.
    """
    by_seed = [result.methods[method] for result in results]
    wrong = [seed["wrong_pct"] for seed in by_seed if seed["wrong_pct"] is not None]
    times_distrusted = Counter(name for result in results for name in result.distrusted)
    row: Row = {
        "case": case.kind,
        "passes_after": case.passes_after,
        "width_m": case.width_m,
        "method": method,
        **{name: _median([seed[name] for seed in by_seed]) for name in FIGURES},
        "wrong_min_pct": min(wrong, default=None),
        "wrong_max_pct": max(wrong, default=None),
        "samples": round(float(np.median([result.samples for result in results]))),
        "cells": round(float(np.median([result.cells for result in results]))),
        "distrusted": dict(sorted(times_distrusted.items())) if method == SERVER else None,
        "wrong_by_seed_pct": wrong,
    }
    return rounded(row, DIGITS)


def _median(values: Sequence[float | None]) -> float | None:
    """Median of known values."""
    known = [value for value in values if value is not None]
    return float(np.median(known)) if known else None


def figures(case: MapCase, scene: MapScene, layers: Layers, seconds: float | None = None) -> Row:
    """FIGURES of a map; None: inapplicable or nothing to judge."""
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
    known = {name: value for name, value in values.items() if math.isfinite(value)}
    return {**dict.fromkeys(FIGURES), **known, "seconds": seconds}


def classes(case: MapCase, scene: MapScene, layers: Layers) -> tuple[Ints, Ints]:
    """Class by cell in map and truth (rows, columns); for gradients 0: right, 1: wrong."""
    if not case.judges_grade:
        return resistance_class(layers["resistance"]), resistance_class(scene.site.c_rr_later)
    east, north = np.moveaxis(scene.site.gradient, -1, 0)
    off = np.hypot(layers["grade_east"] - east, layers["grade_north"] - north)
    estimated = np.where(np.isfinite(off), off > GRADE_TOLERANCE, UNKNOWN).astype(np.int64)
    return estimated, np.zeros_like(estimated)


def near_parked(case: MapCase) -> Bools:
    """Cells (rows, columns) reached by parked machines' stated positions."""
    near: Bools = np.zeros((case.rows, case.columns), np.bool_)
    x_m, y_m = ((np.arange(count) + 0.5) * CELL_M for count in (case.columns, case.rows))
    east, north = parking_place(case)
    for machine in case.machines:
        if machine.parked:
            near |= np.hypot(x_m - east - machine.offset_m, y_m[:, None] - north) < NEAR_M
    return near


def _percent(which: Bools) -> float:
    return 100.0 * float(which.mean()) if which.size else math.nan


# --- in the worker processes -----------------------------------------------------------------------------------------


def _solve(task: Task[MapCase], _: Path) -> CaseResult:
    """Simulate a case, merge by every method, judge."""
    case = task.variant
    scene, window = simulate(case, task.seed), CellWindow(0, 0, case.columns, case.rows)
    names = GRADE if case.judges_grade else RESISTANCE
    rows = in_order(delivery.rows for delivery in scene.deliveries)
    (layers, distrusted), seconds = _timed(partial(soft_votes, scene.deliveries, window))
    judged = {SERVER: figures(case, scene, layers, seconds)}
    for name, method in METHODS.items():
        judged[name] = figures(case, scene, *_timed(partial(merge_hard, method, rows, names, window)))
    return CaseResult(scene.samples, int((scene.driven & scene.site.judged).sum()), list(distrusted), judged)


def _timed(work: Callable[[], Output]) -> tuple[Output, float]:
    """Result and CPU time [s]."""
    began_s = time.process_time()
    return work(), time.process_time() - began_s


EXPERIMENT = Experiment("merge", CaseResult, _solve)
