"""How long a map server takes to open a store with weeks of samples in its journal: snapshot, and the tail after it.

The store is opened by a process of its own, `python -m lab.speed.merge_restart FOLDER`, right after it was written:
its files are still in the system's cache.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from itertools import chain, islice
from pathlib import Path

from lab.speed.measure import START_NS, Report, in_child, machine, timed
from lab.speed.merge_work import A_SECOND, BATCH, batches, seconds_of
from mapserver.config import ServerConfig
from mapserver.evidence import snapshot
from mapserver.evidence.grid import Grid
from mapserver.ingest.snapshot_times import RESTART_SAMPLES
from mapserver.ingest.store import Store
from mapserver.journal.facts import NO_FACTS
from mapserver.journal.location import JOURNAL_FILE, JournalLocation
from mapserver.journal.rows import Admission
from protocol.arrays import Table
from protocol.site.site_config import SiteConfig
from protocol.wire.messages import SampleBatch

SITE, CONFIG = SiteConfig("bench", 48.0, 11.0), ServerConfig()
GOAL_S = 4.0
TAIL_SAMPLES = RESTART_SAMPLES  # as many as a crash can leave without a snapshot
IN_ONE_COMMIT = 10_000  # journal rows: what is measured is the opening, not the writing
MB = 1e6


def run(samples: int) -> Report:
    """Write stores of so many samples, in rows of BATCH and in rows of A_SECOND, and open each.

    Rows: samples in a journal row; open_s of the store alone, open_cpu_s on the CPU (less, where others work as well),
    process_s with the start of Python and its imports, and the sizes on disk.
    """
    rows = [_opened(samples, in_row) for in_row in (BATCH, A_SECOND)]
    return {"benchmark": "restart", "samples": samples, **machine(), "goal_s": GOAL_S, "rows": rows}


def _opened(samples: int, in_row: int) -> dict[str, float]:
    rows = -(-samples // in_row)
    with tempfile.TemporaryDirectory() as path:
        folder = Path(path)
        build_s = timed(lambda: build(folder, rows, TAIL_SAMPLES // in_row, in_row))
        opened_store: Report = {}
        process_s = timed(lambda: opened_store.update(in_child("lab.speed.merge_restart", path)))
        if opened_store["journalled"] != rows or opened_store["merged"] != rows:
            merged = opened_store["merged"]
            raise RuntimeError(f"the store has {merged} of {rows} rows in its grid: nothing was measured")
        sizes = {
            "journal_mb": round((folder / JOURNAL_FILE).stat().st_size / MB, 1),
            "snapshot_mb": round(sum(file.stat().st_size for file in folder.glob("snapshot-*")) / MB, 1),
        }
    return {
        "samples_in_row": in_row,
        "samples": rows * in_row,
        "journal_rows": rows,
        "tail_rows": rows - opened_store["snapshot_row"],
        **sizes,
        "build_s": round(build_s, 1),
        "open_s": round(opened_store["open_s"], 3),
        "open_cpu_s": round(opened_store["open_cpu_s"], 3),
        "process_s": round(process_s, 3),
    }


def build(folder: Path, rows: int, tail_rows: int, in_row: int = BATCH) -> None:
    """Write a journal of so many rows and a snapshot tail_rows before its end, none where it is shorter.

    in_row: samples in a row: BATCH, or A_SECOND as machines send them that are always connected.
    """
    journal, grid = JournalLocation(folder).open(SITE.name, SITE.frame), Grid(SITE.cell_m, CONFIG.fold)
    sent: Counter[str] = Counter()
    journal.begin()
    for number, (name, batch) in enumerate(islice(_rows(in_row), rows), start=1):
        new = SampleBatch(name, 1, sent[name] + 1, batch, SITE.frame)
        journal.append(Admission(new, trimmed=0, lost=0), START_NS)
        sent[name] += len(batch)
        if number <= rows - tail_rows:
            grid.fold(batch, name)
        if number == rows - tail_rows:
            snapshot.save(folder, number, grid.state(), SITE.cell_m, CONFIG.fold, NO_FACTS.of_evidence())
        if number % IN_ONE_COMMIT == 0:
            journal.commit()
            journal.begin()
    journal.commit()
    journal.close()


def _rows(in_row: int) -> Iterator[tuple[str, Table]]:
    return batches() if in_row == BATCH else chain.from_iterable(seconds_of(batches()))


def open_timed(folder: Path) -> Report:
    """Open the store; returns how long that took."""
    start_s, start_cpu_s = time.perf_counter(), time.process_time()
    store = Store(JournalLocation(folder), SITE, CONFIG, lambda: START_NS)
    open_s, open_cpu_s = time.perf_counter() - start_s, time.process_time() - start_cpu_s
    rows = {"journalled": store.journalled, "merged": store.merged, "snapshot_row": store.snapshot_row}
    store.close()
    return {"open_s": open_s, "open_cpu_s": open_cpu_s, **rows}


if __name__ == "__main__":
    from mapserver import server  # noqa: F401 # a server's imports count in the time of the process

    print(json.dumps(open_timed(Path(sys.argv[1]))))
