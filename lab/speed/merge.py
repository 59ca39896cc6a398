"""The map server's fold, against plain sums per cell.

All variants take the same structured rows. Plain sums accumulate. Soft votes start a new grid per run, because repeated
drives happen at other times, and include folding and settling of pending samples at the end.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numba
import numpy as np

from lab.speed.measure import SIDE_M, in_turn, rows_of, scattered, timed, track
from mapserver.evidence.fold_config import FoldConfig
from mapserver.evidence.grid import LIVE_ROWS, REFOLD_ROWS, Grid
from protocol.arrays import Floats, Table
from sitegrid.proof.figures import Row

OPTIONS = {"runs": 5, "samples": 200_000}
GOALS: dict[tuple[str, str], str] = {}
PATTERNS = {"track": track, "random": scattered}
BATCH = 100  # a machine's batch of a few seconds
PIECE = 5000  # samples per call in whole runs
BATCHED_SHARE = 10  # batches are measured on a tenth of the samples
RANDOM_SHARE = 10  # slow, so measured on a tenth
YARDSTICK = "np.add.at"
SECOND_NS = 10**9
MOST_TOUCHED = 9  # blocks per sample
SIDE = int(SIDE_M)
Fold = Callable[[Table], object]
Start = Callable[[], tuple[Fold, Callable[[], object]]]  # of a run: its fold function, and its end


@dataclass(frozen=True)
class SoftVotes:
    """The server's fold. read_ns: touched pages are read at this site-time interval."""

    waiting_rows: int
    read_ns: int = 0

    def __call__(self) -> tuple[Fold, Callable[[], object]]:
        """Start a run on a new grid."""
        grid = Grid(1.0, FoldConfig(), self.waiting_rows)

        def fold(rows: Table) -> None:
            for part in spans(rows, self.read_ns):
                grid.fold(part, "loader-1")
                if self.read_ns:
                    for pages in grid.pages(grid.take_touched(len(rows) * MOST_TOUCHED)):
                        len(pages)

        return fold, grid.state  # folds pending rows and settles all pages


def spans(rows: Table, span_ns: int) -> Iterator[Table]:
    """Split samples, sorted by stamp, at multiples of span_ns; 0: not at all."""
    if not span_ns:
        yield rows
        return
    number = rows["stamp_ns"] // span_ns
    first = 0
    while first < len(rows):
        end = int(number.searchsorted(number[first], "right"))
        yield rows[first:end]
        first = end


def sums() -> Floats:
    """Count, sum, sum of squares per cell (SIDE * SIDE, 3)."""
    return np.zeros((SIDE * SIDE, 3))


def add_at(total: Floats, rows: Table) -> None:
    """Add c_rr to cell sums by numpy, once per sum."""
    cell = rows["y_m"].astype(np.int64) * SIDE + rows["x_m"].astype(np.int64)
    value = rows["c_rr"].astype(np.float64)
    for column, added in zip(total.T, (np.ones_like(value), value, value * value), strict=True):
        np.add.at(column, cell, added)


def add_by_loop(total: Floats, rows: Table) -> None:
    """The same in a compiled loop over interleaved sums: one cache miss per sample, not three."""
    _add(rows, total.reshape(-1), SIDE)


@numba.njit(cache=True, nogil=True)
def _add(rows: Any, total: Any, side: int) -> None:
    """Unsigned indices spare numba the test for negative ones."""
    one, two, three = np.uintp(1), np.uintp(2), np.uintp(3)
    for k in range(len(rows)):
        row = rows[k]
        at = three * (np.uintp(row.y_m) * np.uintp(side) + np.uintp(row.x_m))
        value = np.float64(row.c_rr)  # float() would stay single
        total[at] += 1.0
        total[at + one] += value
        total[at + two] += value * value


def _plain(add: Callable[[Floats, Table], None], total: Floats) -> Start:
    """All runs share sums with touched memory."""
    return lambda: (partial(add, total), lambda: None)


def variants() -> dict[str, Start]:
    """Run starters by variant."""
    apart = np.zeros((3, SIDE * SIDE)).T  # contiguous sums, best for numpy
    return {
        "soft votes, folded again": SoftVotes(REFOLD_ROWS),
        "soft votes, live": SoftVotes(LIVE_ROWS),
        "soft votes, live and read": SoftVotes(LIVE_ROWS, SECOND_NS),
        "sums in a loop": _plain(add_by_loop, sums()),
        YARDSTICK: _plain(add_at, apart),
    }


def run(samples: int, runs: int) -> Iterator[Row]:
    """Every variant on every pattern: whole runs, and batches of 100 as from machines.

    msamples_per_s: wall; cpu_msamples_per_s; times_add_at: ratio to the yardstick; batch_us: median call, wall;
    batch_cpu_us: total per batch, end included.
    """
    starts = variants()
    for pattern, draw in PATTERNS.items():
        drawn = draw(samples)
        parts = {name: drawn[: _share(samples, name, pattern)] for name in starts}
        few = {name: part[: max(BATCH, len(part) // BATCHED_SHARE)] for name, part in parts.items()}
        for name, start in starts.items():
            took(start, parts[name], PIECE)  # compiles, touches memory
        whole = in_turn({name: partial(took, start, parts[name], PIECE) for name, start in starts.items()}, runs)
        batched = in_turn({name: partial(took, start, few[name], BATCH) for name, start in starts.items()}, runs)
        pace = {name: len(parts[name]) / max(each["cpu_s"], 1e-9) / 1e6 for name, each in whole.items()}
        for name in starts:
            figures = {
                "msamples_per_s": len(parts[name]) / whole[name]["wall_s"] / 1e6,
                "cpu_msamples_per_s": pace[name],
                "times_add_at": pace[name] / pace[YARDSTICK],
                "batch_us": batched[name]["call_s"] * 1e6,
                "batch_cpu_us": batched[name]["cpu_s"] / (len(few[name]) / BATCH) * 1e6,
            }
            yield from rows_of(f"{pattern}, {name}", figures)


def took(start: Start, rows: Table, piece: int) -> dict[str, float]:
    """One run: `wall_s`, `cpu_s`, and median call time `call_s`."""
    fold, end = start()
    fresh = rows.copy()  # cached as after decoding, for all variants alike
    calls_s: list[float] = []

    def work() -> None:
        for first in range(0, len(fresh), piece):
            began_s = time.perf_counter()
            fold(fresh[first : first + piece])
            calls_s.append(time.perf_counter() - began_s)
        end()

    return {**timed(work), "call_s": statistics.median(calls_s)}


def _share(samples: int, name: str, pattern: str) -> int:
    """Number of measured samples, in whole batches."""
    share = RANDOM_SHARE if pattern == "random" and name.startswith("soft") else 1
    return min(samples, max(1, samples // share // BATCH) * BATCH)
