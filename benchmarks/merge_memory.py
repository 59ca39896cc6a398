"""What a day of work takes of the map server's memory, and of its disk for a snapshot.

The day is folded in a process of its own, `python -m benchmarks.merge_memory HOURS`, with the imports of a server.
"""

from __future__ import annotations

import json
import sys
import tempfile
from itertools import islice
from pathlib import Path

import numpy as np

from benchmarks.measure import Report, in_child, machine, memory_mb, timed
from benchmarks.merge_work import BATCH, batches, samples_of
from mapserver.evidence import snapshot
from mapserver.evidence.fold_config import FoldConfig
from mapserver.evidence.grid import Grid
from mapserver.evidence.pages import CompactPages

GOALS = {"bytes_per_cell_and_bucket": 500, "resident_mb": 400}
MB = 1e6


def run(hours: float) -> Report:
    """Fold so many hours of work; a row of what it took.

    bytes_per_cell_and_bucket: of pages that still hold one bucket. evidence_mb: of all pages. resident_mb, peak_mb: of
    the process after the last sample, and the most there was, a snapshot included.
    """
    row = in_child("benchmarks.merge_memory", str(hours))
    return {"benchmark": "memory", "hours": hours, **machine(), "goals": GOALS, "rows": [row]}


def measured(hours: float) -> dict[str, float]:
    """What `run` gives as its row, of this process."""
    from mapserver import server  # noqa: F401 # zenoh, sqlite and the plotter's libraries are resident as well

    grid = Grid(1.0, FoldConfig())
    for name, rows in islice(batches(), samples_of(hours) // BATCH):
        grid.fold(rows, name)
    resident_mb = memory_mb()
    blocks = [pages for _, _, pages in grid.state().blocks]
    evidence_bytes = sum(map(_bytes, blocks))
    row = {
        "samples": grid.folded,
        "pages": sum(len(pages.table) for pages in blocks),
        "cells": grid.known_cells(),
        "bytes_per_cell_and_bucket": round(evidence_bytes / max(1, sum(len(pages.marks) for pages in blocks)), 1),
        "evidence_mb": round(evidence_bytes / MB, 1),
        "resident_mb": round(max(resident_mb, memory_mb()), 1),  # with all pages packed, or with blocks open
    }
    return row | _snapshot(grid)


def _bytes(pages: CompactPages) -> int:
    """Bytes of the pages of one block, with their Python objects."""
    return pages.nbytes + sys.getsizeof(pages) + len(pages.__slots__) * sys.getsizeof(np.empty(0))


def _snapshot(grid: Grid) -> dict[str, float]:
    """Write the grid and read it again."""
    with tempfile.TemporaryDirectory() as folder:
        save_s = timed(lambda: snapshot.save(Path(folder), 1, grid.state(), grid.cell_m, grid.config))
        path, peak_mb = Path(folder) / "snapshot-1.npz", memory_mb("VmHWM")
        loaded: list[object] = []
        load_s = timed(lambda: loaded.append(snapshot.load(path, grid.cell_m, grid.config)))
        if loaded == [None]:
            raise RuntimeError("the snapshot cannot be read: nothing was measured")
        size_mb = path.stat().st_size / MB
    return {
        "peak_mb": round(peak_mb, 1),
        "snapshot_mb": round(size_mb, 1),
        "snapshot_save_s": round(save_s, 3),
        "snapshot_load_s": round(load_s, 3),
    }


if __name__ == "__main__":
    print(json.dumps(measured(float(sys.argv[1]))))
