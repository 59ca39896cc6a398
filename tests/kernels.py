"""Numba's kernels, compiled once per clone although test processes start concurrently.

One process starts with roads, the other with the simulator; the second one at a part loads it from the cache.
"""

from __future__ import annotations

import fcntl
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

from mapserver.calibration import ledger
from mapserver.change import change_log
from mapserver.config import ServerConfig
from mapserver.evidence import fold_kernels, grid
from mapserver.ingest import batches, block_credit
from mapserver.journal import records
from mapserver.query import road_maps, routes
from sim.worlds import fast
from sitegrid.process.kernels import drop_stale
from tests.unit.mapserver.data import NOW_NS, folded, samples
from tests.unit.sim.planes import LOADER, idle, placed, plane

FOLD = ServerConfig().fold
TWO = samples(2, stamp_ns=[NOW_NS, NOW_NS + 10**12], c_rr=[0.01, 0.3])


def pages() -> Any:
    """Of a fold, the base of the first half."""
    (folded_pages,) = folded(TWO).pages([(0, 0)])
    return folded_pages


def world() -> None:
    with placed(fast.FastWorld, plane(0), LOADER) as placed_world:
        idle(placed_world, 0.01)


# Module of the kernels, whether they need a fold, and their compilation.
PARTS: tuple[tuple[ModuleType, bool, Callable[[], object]], ...] = (
    (road_maps, True, lambda: road_maps.warm_up(FOLD)),
    (grid, True, lambda: grid.warm_up(FOLD)),
    (block_credit, True, lambda: block_credit.warm_up(FOLD)),
    (change_log, True, lambda: change_log.warm_up(FOLD)),
    (ledger, False, ledger.warm_up),
    (batches, False, batches.warm_up),
    (records, False, records.warm_up),
    (routes, False, routes.warm_up),
    (fast, False, world),
)


def compile_all(*, from_the_end: bool) -> None:
    """Compile or load all kernels used by tests."""
    drop_stale()
    for module, folds, compile_part in reversed(PARTS) if from_the_end else PARTS:
        if folds:
            _alone(fold_kernels, pages)
        _alone(module, compile_part)


def _alone(module: ModuleType, compile_part: Callable[[], object]) -> None:
    """Exclude other processes meanwhile."""
    with Path(str(module.__file__)).open("rb") as locked:
        fcntl.flock(locked, fcntl.LOCK_EX)
        compile_part()
