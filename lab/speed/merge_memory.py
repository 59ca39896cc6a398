"""What a day of work takes of the map server's memory, and of its disk for a snapshot.

Twice: the grid alone, folded in a process of its own (`python -m lab.speed.merge_memory HOURS`) with the imports of a
server; and a real server that has opened the day's store, has audited its machines and answered for all of the site.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections.abc import Callable
from itertools import islice
from pathlib import Path

import numpy as np

from lab.speed.measure import Report, in_child, machine, memory_mb, timed
from lab.speed.merge_restart import SITE, build
from lab.speed.merge_work import BATCH, batches, samples_of
from lab.speed.processes import OPTIONS, ask, send, served, session
from mapserver.evidence import snapshot
from mapserver.evidence.fold_config import FoldConfig
from mapserver.evidence.grid import Grid
from mapserver.evidence.pages import CompactPages
from protocol.queries.answer_codec import decode_machines
from protocol.wire import keys
from protocol.wire.messages import SampleBatch

GOALS = {
    "bytes_per_cell_and_bucket": 48,
    "evidence_mb": 95,
    "resident_mb": 400,
    "server_mb": 450,
    "snapshot_ratio": 1.4,
}
MB = 1e6
SNAPSHOT_S, DEADLINE_S = 2.0, 120.0


def run(hours: float) -> Report:
    """Fold so many hours of work; a row of what it took.

    bytes_per_cell_and_bucket: of pages that still hold one bucket. evidence_mb: of all pages. resident_mb, peak_mb: of
    the process that folds, after the last sample, and the most there was, a snapshot included. server_mb: of a real
    server at rest; server_snapshot_mb: the most while it writes a snapshot, and its ratio to that.
    """
    row = in_child("lab.speed.merge_memory", str(hours)) | served_mb(hours)
    return {"benchmark": "memory", "hours": hours, **machine(), "goals": GOALS, "rows": [row]}


def measured(hours: float) -> dict[str, float]:
    """What a grid takes of this process."""
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
        "resident_mb": round(max(resident_mb, memory_mb()), 1),  # with all pages settled, or with some that wait
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


def served_mb(hours: float) -> dict[str, float]:
    """What a real server takes."""
    with tempfile.TemporaryDirectory() as path:
        folder, rows = Path(path), samples_of(hours) // BATCH
        build(folder, rows, tail_rows=0)
        with (
            served(folder, SITE, f"{OPTIONS}snapshot_s = {SNAPSHOT_S}\n") as (endpoint, pid),
            session(endpoint) as link,
        ):
            ask(link, keys.map_query(SITE.name, "region") + "?bounds=0,0,1000,1000;layers=resistance,grade")
            _wait("judged its machines", lambda: _are_judged(ask(link, keys.map_query(SITE.name, "machines"))[0]))
            server_mb = memory_mb(pid=pid)
            Path(f"/proc/{pid}/clear_refs").write_text("5")  # the most there ever was counts from here
            name, more = next(islice(batches(), rows, None))
            send(link, SITE, SampleBatch(name, 2, 1, more, SITE.frame))
            _wait("written a snapshot", (folder / f"snapshot-{rows + 1}.npz").exists)
            most_mb = memory_mb("VmHWM", pid)
    ratio = round(most_mb / server_mb, 2)
    return {"server_mb": round(server_mb, 1), "server_snapshot_mb": round(most_mb, 1), "snapshot_ratio": ratio}


def _are_judged(machines: bytes) -> bool:
    return all("cells" in machine.evidence for machine in decode_machines(machines).machines)


def _wait(what: str, condition: Callable[[], bool]) -> None:
    end_s = time.monotonic() + DEADLINE_S
    while not condition():
        if time.monotonic() > end_s:
            raise RuntimeError(f"the server has not {what} within {DEADLINE_S:g} s: nothing was measured")
        time.sleep(0.05)


if __name__ == "__main__":
    print(json.dumps(measured(float(sys.argv[1]))))
