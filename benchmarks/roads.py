"""Roads of a site of 40 km: made from the evidence, made again after a minute of work, and the worklist of a day."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from benchmarks.measure import START_NS, Report, machine, medians
from mapserver.evidence.fold_config import FoldConfig
from mapserver.evidence.grid import Grid
from mapserver.roads.ledger import Ledgers
from mapserver.roads.loss import losses
from mapserver.roads.network import network
from mapserver.roads.segments import Segments, segments
from mapserver.roads.skeleton import Pages, Skeletons
from mapserver.roads.tally import HOUR_NS, Tally
from mapserver.roads.trend import trends
from mapserver.roads.worklist import ranked
from protocol.arrays import Table
from protocol.machine.samples import empty
from protocol.site.geometry import CellWindow

GOALS_MS = {"minute": 50.0, "worklist": 300.0}
ROADS, LENGTH_M, APART_M, STEP_M = 20, 1000.0, 50.0, 0.5  # as many along either axis: 40 km, 400 crossings
TRUCKS, MINUTE_M = 10, 480.0  # at 8 m/s
TARGET = 0.02
SITE = CellWindow(-100, -100, 1300, 1300)


def run(hours: float, runs: int) -> Report:
    """Rows: what is made, and the median of its processor time in ms; counts of what there is."""
    grid, tally = Grid(1.0, FoldConfig()), Tally()
    for hour in range(round(hours)):
        for road in range(2 * ROADS):
            rows = _pass(road, hour)
            if hour < 2:
                grid.fold(rows, f"truck-{road % TRUCKS}")
            tally.add(rows, np.full(len(rows), np.uint64(road % TRUCKS) << np.uint64(58)))
    skeletons = Skeletons(1.0)
    roads = _roads(skeletons, grid)
    ledgers = Ledgers(roads)

    def minute() -> float:
        first = skeletons.made % (2 * ROADS)
        for truck in range(TRUCKS):
            grid.fold(_pass((first + truck) % (2 * ROADS), 3)[: round(MINUTE_M / STEP_M)], f"truck-{truck}")
        pages = _pages(grid)  # folded before it is timed: that is the fold's work
        return _timed(lambda: segments(network(skeletons.skeleton(pages))))

    def worklist() -> float:
        return _timed(lambda: _worklist(ledgers, tally))

    variants = {
        "whole": lambda: _timed(lambda: _roads(Skeletons(1.0), grid)),
        "minute": minute,
        "ledgers": lambda: _timed(lambda: Ledgers(roads)),
        "worklist": worklist,
    }
    for variant in variants.values():
        variant()  # compiled
    found_ms = {name: 1e3 * seconds for name, seconds in medians(variants, runs).items()}
    counts = {
        "km": round(float(roads.length_m.sum()) / 1000, 2),
        "segments": len(roads.ids),
        "tally_rows": len(tally.table()),
        "tally_mb": round(tally.table().nbytes / 1e6, 1),
    }
    table = [{"made": name, "cpu_ms": round(ms, 1), "goal": GOALS_MS.get(name)} for name, ms in found_ms.items()]
    return {"benchmark": "roads", "hours": hours, **machine(), **counts, "rows": table}


def _pass(road: int, hour: int) -> Table:
    """Samples along one road, two metres from the last pass at most."""
    draw = np.random.default_rng([road, hour])
    along = np.arange(0.0, LENGTH_M, STEP_M)
    beside = np.full(len(along), road % ROADS * APART_M + 25.0 + draw.normal(0.0, 0.4))
    rows = empty(len(along))
    rows["x_m"], rows["y_m"] = (along, beside) if road < ROADS else (beside, along)
    rows["heading_rad"] = 0.0 if road < ROADS else np.pi / 2
    rows["cov_xx_m2"] = rows["cov_yy_m2"] = 0.25
    rows["speed_mps"], rows["distance_m"], rows["mass_kg"] = 8.0, STEP_M, 40_000.0
    rows["c_rr"] = 0.02 + 0.02 * draw.random() + draw.normal(0.0, 0.003, len(along))
    rows["stamp_ns"] = START_NS + hour * HOUR_NS + np.arange(len(along)) * 62_500_000
    return rows


def _pages(grid: Grid) -> Pages:
    blocks = grid.blocks_in(SITE)
    return dict(zip(blocks, grid.pages(blocks), strict=True))


def _roads(skeletons: Skeletons, grid: Grid) -> Segments:
    return segments(network(skeletons.skeleton(_pages(grid))))


def _worklist(ledgers: Ledgers, tally: Tally) -> None:
    ledger = ledgers.ledger(tally.table(), HOUR_NS)
    ranked(losses(ledger, ledgers.segments, TARGET))
    trends(ledger)


def _timed(work: Callable[[], object]) -> float:
    began_s = time.process_time()
    work()
    return time.process_time() - began_s
