"""Samples per second of the fold: the server's own, and plain sums per cell by several libraries as yardsticks.

Every variant takes the same structured rows; what its library wants made of them first is part of its time. Plain sums
are added to what is there. Soft votes go into a new grid in each run, since ground that is driven again is driven at
another time, and count what waits to be folded and settled at the end.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field

from lab.speed.measure import SIDE_M, Report, machine, scattered, track
from lab.speed.merge_sums import AddAt, BoostHistogram, DuckDb, HardVotes, PlainC, Polars, Sums
from mapserver.evidence.fold_config import FoldConfig
from mapserver.evidence.grid import LIVE_ROWS, REFOLD_ROWS, Grid
from protocol.arrays import Table

PATTERNS = {"track": track, "random": scattered}
BATCH = 100  # what a machine sends every few seconds
PIECE = 5000  # whole runs in pieces of this size
BATCHED_SHARE = 10  # batches are measured on a tenth of the samples: calls of data frames take milliseconds
YARDSTICK = "np.add.at"
SECOND_NS = 10**9
Fold = Callable[[Table], object]
End = Callable[[], object]
Start = Callable[[], tuple[Fold, End]]  # of a run: what folds samples, and what ends the run


@dataclass(frozen=True)
class Variant:
    """A way to merge samples.

    make: gives what starts a run; ImportError or FileNotFoundError where something is missing, and install says what.
    buffer: of soft votes. shares: of each pattern one in so many samples is folded, where that is not all: the slow
    ones need not take minutes.
    """

    make: Callable[[], Start]
    install: str = ""
    buffer: str | None = None
    shares: Mapping[str, int] = field(default_factory=dict)


def _soft_votes(buffer: str, waiting_rows: int, read_ns: int = 0) -> Variant:
    """The server's own fold. read_ns: after so much of the site's time all pages that were touched are read."""

    def start() -> tuple[Fold, End]:
        grid = Grid(1.0, FoldConfig(), waiting_rows)

        def fold(rows: Table) -> None:
            for part in _spans(rows, read_ns):
                grid.fold(part, "loader-1")
                if read_ns:
                    for pages in grid.pages(grid.take_touched(len(rows) * MOST_TOUCHED)):
                        len(pages)

        return fold, grid.state  # which folds what waits, and settles all pages

    return Variant(lambda: start, buffer=buffer, shares={"random": 10})


def _spans(rows: Table, span_ns: int) -> Iterator[Table]:
    """Cut samples, in the order of their stamps, where a span of time ends; not at all where it is 0."""
    if not span_ns:
        yield rows
        return
    spans = rows["stamp_ns"] // span_ns
    first = 0
    while first < len(rows):
        end = int(spans.searchsorted(spans[first], "right"))
        yield rows[first:end]
        first = end


def _sums(make: Callable[[int], Sums], install: str = "") -> Variant:
    """Plain sums of a library; all runs add to the same ones, whose memory has been touched."""

    def started() -> Start:
        sums = make(SIDE)
        return lambda: (sums.fold, lambda: None)

    return Variant(started, install)


SIDE = int(SIDE_M)
MOST_TOUCHED = 9  # blocks by one sample
BENCH = "pip install '.[bench]'"
VARIANTS = {
    "soft_votes": _soft_votes("refold", REFOLD_ROWS),
    "soft_votes, live": _soft_votes("live", LIVE_ROWS),
    "soft_votes, live, read": _soft_votes("live_read", LIVE_ROWS, SECOND_NS),
    "hard_votes": _sums(HardVotes),
    "hard_votes in C": _sums(PlainC, "a C compiler named `cc`"),
    YARDSTICK: _sums(AddAt),
    "boost_histogram": _sums(BoostHistogram, BENCH),
    "polars group-by": _sums(Polars, BENCH),
    "duckdb group-by": _sums(DuckDb, BENCH),
}


@dataclass(frozen=True)
class Took:
    """What a run took: seconds by the clock and of the processor, and the median of its calls by the clock."""

    wall_s: float
    cpu_s: float
    call_s: float


def run(samples: int, runs: int) -> Report:
    """Measure every variant that can be had on every pattern, in turn.

    Rows: variant and its buffer, pattern, samples of a whole run, million samples per second of whole runs by the clock
    and of processor time, the latter's ratio to the yardstick's; for batches of 100, microseconds by the clock of the
    median call, and of processor time of all calls and of the end of the run, per batch. missing: variants that were
    not measured, and what to install for each.
    """
    starts, missing = _made()
    rows = [row for pattern in PATTERNS for row in _measured(pattern, starts, samples, runs)]
    return {"benchmark": "merge", "samples": samples, "runs": runs, **machine(), "rows": rows, "missing": missing}


def _made() -> tuple[dict[str, Start], dict[str, str]]:
    """What starts the runs of each variant, and what to install for those of which something is missing."""
    starts, missing = {}, {}
    for name, variant in VARIANTS.items():
        try:
            starts[name] = variant.make()
        except (ImportError, FileNotFoundError):
            missing[name] = variant.install
    return starts, missing


def _measured(
    pattern: str, starts: Mapping[str, Start], samples: int, runs: int
) -> Iterator[dict[str, str | float | None]]:
    """Rows of one pattern."""
    drawn = PATTERNS[pattern](samples)
    parts = {name: drawn[: _share(samples, VARIANTS[name].shares.get(pattern, 1))] for name in starts}
    few = {name: part[: _share(samples, BATCHED_SHARE)] for name, part in parts.items()}
    for name, start in starts.items():
        _took(start, parts[name], PIECE)  # compiled, and every page of memory touched
    whole = dict(_in_turn(starts, parts, PIECE, runs))
    batched = dict(_in_turn(starts, few, BATCH, runs))
    pace = {name: len(parts[name]) / max(took.cpu_s, 1e-9) for name, took in whole.items()}
    for name in starts:
        yield {
            "variant": name,
            "buffer": VARIANTS[name].buffer,
            "pattern": pattern,
            "samples": len(parts[name]),
            "msamples_per_s": float(f"{len(parts[name]) / whole[name].wall_s / 1e6:.3g}"),
            "cpu_msamples_per_s": float(f"{pace[name] / 1e6:.3g}"),
            "ratio_to_add_at": float(f"{pace[name] / pace[YARDSTICK]:.3g}"),
            "batch_us_median": round(batched[name].call_s * 1e6, 1),
            "batch_us_amortised": round(batched[name].cpu_s / (len(few[name]) / BATCH) * 1e6, 1),
        }


def _in_turn(
    starts: Mapping[str, Start], parts: Mapping[str, Table], piece: int, runs: int
) -> Iterator[tuple[str, Took]]:
    """Medians of each variant; one run of each in turn, so that all meet the same disturbances."""
    taken: dict[str, list[Took]] = {name: [] for name in starts}
    for _ in range(runs):
        for name, start in starts.items():
            taken[name].append(_took(start, parts[name], piece))
    for name, runs_of_one in taken.items():
        columns = ((one.wall_s, one.cpu_s, one.call_s) for one in runs_of_one)
        yield name, Took(*map(statistics.median, zip(*columns, strict=True)))


def _took(start: Start, rows: Table, piece: int) -> Took:
    """One run."""
    fold, end = start()
    fresh = rows.copy()  # is in the caches as after decoding: the first in turn does not load it for the others
    calls_s: list[float] = []
    start_s, start_cpu_s = time.perf_counter(), time.process_time()
    for first in range(0, len(fresh), piece):
        began_s = time.perf_counter()
        fold(fresh[first : first + piece])
        calls_s.append(time.perf_counter() - began_s)
    end()
    return Took(time.perf_counter() - start_s, time.process_time() - start_cpu_s, statistics.median(calls_s))


def _share(samples: int, share: int) -> int:
    """One in so many samples, in whole batches."""
    return min(samples, max(1, samples // share // BATCH) * BATCH)
