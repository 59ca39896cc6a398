"""Samples per second of the fold: the server's own, and plain sums per cell by several libraries as yardsticks.

Every variant takes the same structured rows; what its library wants made of them first is part of its time. All fold
into what they already have, as a server does that is at work: soft votes also pack, now and then, what they unpacked.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial

from benchmarks.measure import SIDE_M, Report, machine, medians, scattered, timed, track
from benchmarks.merge_sums import AddAt, BoostHistogram, DuckDb, HardVotes, Polars
from mapserver.evidence.fold_config import FoldConfig
from mapserver.evidence.grid import LIVE_ROWS, REFOLD_ROWS, Grid
from protocol.arrays import Table

PATTERNS = {"track": track, "random": scattered}
BATCH = 100  # what a machine sends every few seconds
PIECE = 5000  # whole runs in pieces of this size
BATCHED_SHARE = 10  # batches are measured on a tenth of the samples: calls of data frames take milliseconds
YARDSTICK = "np.add.at"
Fold = Callable[[Table], None]


@dataclass(frozen=True)
class Variant:
    """A way to merge samples.

    make: gives a fold, or ImportError where its library is missing; install: what to install then. shares: of each
    pattern one in so many samples is folded, where that is not all: the slow ones need not take minutes.
    """

    make: Callable[[], Fold]
    install: str = ""
    shares: Mapping[str, int] = field(default_factory=dict)


class SoftVotes:
    """The server's own fold. Samples wait to be folded together, so what waits counts as well, in `settle`."""

    def __init__(self, waiting_rows: int) -> None:
        self._grid = Grid(1.0, FoldConfig(), waiting_rows)

    def __call__(self, rows: Table) -> None:
        """Fold samples of one machine."""
        self._grid.fold(rows, "loader-1")

    def settle(self) -> None:
        """Fold what waits, and bring all pages into the form in which they are kept."""
        self._grid.state()


SIDE = int(SIDE_M)
BENCH = "pip install 'sitegrid[bench]'"
VARIANTS = {
    "soft_votes": Variant(lambda: SoftVotes(LIVE_ROWS), shares={"random": 10}),
    "soft_votes, refold": Variant(lambda: SoftVotes(REFOLD_ROWS), shares={"random": 10}),
    "hard_votes": Variant(lambda: HardVotes(SIDE).fold),
    YARDSTICK: Variant(lambda: AddAt(SIDE).fold),
    "boost_histogram": Variant(lambda: BoostHistogram(SIDE).fold, BENCH),
    "polars group-by": Variant(lambda: Polars(SIDE).fold, BENCH),
    "duckdb group-by": Variant(lambda: DuckDb(SIDE).fold, BENCH),
}


def run(samples: int, runs: int) -> Report:
    """Measure every variant whose library is there on every pattern.

    Rows: variant, pattern, samples of a whole run, million samples per second of whole runs, their ratio to the
    yardstick's, and microseconds for a batch of 100. missing: variants that were not measured, and what to install for
    each.
    """
    rows: list[dict[str, str | float]] = []
    missing: dict[str, str] = {}
    for pattern, draw in PATTERNS.items():
        folds, missing = _made()
        drawn = draw(samples)
        parts = {name: drawn[: _share(samples, VARIANTS[name].shares.get(pattern, 1))] for name in folds}
        few = {name: part[: _share(samples, BATCHED_SHARE)] for name, part in parts.items()}
        rows += _measured(pattern, folds, parts, few, runs)
    return {"benchmark": "merge", "samples": samples, "runs": runs, **machine(), "rows": rows, "missing": missing}


def _made() -> tuple[dict[str, Fold], dict[str, str]]:
    """A new fold of each variant, and what to install for those whose library is missing."""
    folds, missing = {}, {}
    for name, variant in VARIANTS.items():
        try:
            folds[name] = variant.make()
        except ImportError:
            missing[name] = variant.install
    return folds, missing


def _measured(
    pattern: str, folds: Mapping[str, Fold], parts: Mapping[str, Table], few: Mapping[str, Table], runs: int
) -> list[dict[str, str | float]]:
    """Rows of one pattern, all variants in turn; few: the samples that are folded in batches."""
    for name, fold in folds.items():
        fold(parts[name])  # compiled, and every block allocated
    whole_s = medians({name: _timer(fold, parts[name], PIECE) for name, fold in folds.items()}, runs)
    batched_s = medians({name: _timer(fold, few[name], BATCH) for name, fold in folds.items()}, runs)
    pace = {name: len(parts[name]) / whole_s[name] for name in folds}
    return [
        {
            "variant": name,
            "pattern": pattern,
            "samples": len(parts[name]),
            "msamples_per_s": float(f"{pace[name] / 1e6:.3g}"),
            "ratio_to_add_at": float(f"{pace[name] / pace[YARDSTICK]:.3g}"),
            "us_per_batch_of_100": round(batched_s[name] / (len(few[name]) / BATCH) * 1e6, 1),
        }
        for name in folds
    ]


def _share(samples: int, share: int) -> int:
    """One in so many samples, in whole batches."""
    return min(samples, max(1, samples // share // BATCH) * BATCH)


def _timer(fold: Fold, rows: Table, piece: int) -> Callable[[], float]:
    def fold_pieces(fresh: Table) -> None:
        for first in range(0, len(fresh), piece):
            fold(fresh[first : first + piece])
        if isinstance(fold, SoftVotes):
            fold.settle()

    # a copy is in the caches as after decoding: the first in turn does not load it for the others
    return lambda: timed(partial(fold_pieces, rows.copy()))
