"""Time to open a store or fold its whole journal, and memory of the map.

Separate processes, `python -m lab.speed.restart WHAT ...`, right after writing, thus from the file cache.
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from itertools import islice
from pathlib import Path

from lab.speed.measure import Figures, in_child, in_turn, rows_of, timed
from lab.speed.site import OPTIONS as STORE_OPTIONS
from lab.speed.site import SITE, Site, ask, forget_peak_mb, send, session
from mapserver.config import ServerConfig
from mapserver.evidence.grid import Grid, warm_up
from mapserver.evidence.pages import Pages
from mapserver.ingest.store import Store
from mapserver.journal.history import History, fold_history
from mapserver.journal.location import JOURNAL_FILE, JournalLocation
from mapserver.past.checkpoint_file import Checkpoint
from mapserver.past.checkpoints import save_snapshot, snapshot_path
from mapserver.past.past import StorePast
from mapserver.upkeep.snapshots import RESTART_SAMPLES
from protocol.queries.answer_codec import decode_machines
from protocol.wire import keys
from protocol.wire.messages import SampleBatch
from sitegrid.process.children import wait_until
from sitegrid.proof.figures import Row
from tests.memory import memory_mb
from tests.site_work import A_SECOND, BATCH, HOURS, START_NS, batches, samples_of, write_store

OPTIONS = {"samples": 20_000_000, "hours": HOURS, "runs": 1}
GOALS = {
    ("open, rows of 100", "process_s"): "<= 4",
    ("open, rows of 6", "process_s"): "<= 4",
    ("fold, 1 thread", "wall_s"): "<= 45",
    ("fold, 1 thread", "cpu_s"): "<= 30",
    ("fold, 2 threads", "times_one_thread"): ">= 1.5",
    ("grid", "bytes_per_cell_and_bucket"): "<= 48",
    ("grid", "resident_mb"): "<= 400",
    ("server", "resident_mb"): "<= 450",
    ("server", "times_with_snapshot"): "<= 1.4",
}
CONFIG = ServerConfig()
THIS = "lab.speed.restart"
TAIL_SAMPLES = RESTART_SAMPLES  # most that a crash leaves without snapshot
SNAPSHOT_S, DEADLINE_S = 2.0, 120.0
MB = 1e6


def run(samples: int, hours: float, runs: int) -> Iterator[Row]:
    """Stores of `samples`, and memory after `hours` of work.

    open: store with snapshot and tail, in rows of 100 and of 6 samples; process_s: with Python's start and imports.
    fold: journal without snapshot, by threads. grid: process that folds the work; server: a real one after judging and
    answering for the whole site, at rest, and the peak during a snapshot.
    """
    for in_row in (BATCH, A_SECOND):
        yield from rows_of(f"open, rows of {in_row}", _opened(samples, in_row))
    with tempfile.TemporaryDirectory() as path:
        rows = -(-samples // BATCH)
        write_store(Path(path), SITE, rows, tail_rows=rows)
        threads = {f"fold, {n} thread{'s' * (n > 1)}": partial(in_child, THIS, "fold", path, str(n)) for n in (1, 2)}
        took = in_turn(threads, runs)
        for name, figures in took.items():
            faster = took["fold, 1 thread"]["wall_s"] / figures["wall_s"]
            pace = figures["samples"] / figures["cpu_s"] / 1e6
            yield from rows_of(name, {**figures, "msamples_per_cpu_s": pace, "times_one_thread": faster})
    yield from rows_of("grid", in_child(THIS, "grid", str(hours)))
    yield from rows_of("server", served(hours))


def _opened(samples: int, in_row: int) -> Figures:
    rows = -(-samples // in_row)
    with tempfile.TemporaryDirectory() as path:
        write_store(Path(path), SITE, rows, TAIL_SAMPLES // in_row, in_row)
        store: dict[str, float] = {}
        process_s = timed(lambda: store.update(in_child(THIS, "open", path)))["wall_s"]
        if store["journalled"] != rows or store["merged"] != rows:
            raise RuntimeError(f"the store has {store['merged']} of {rows} rows in its grid: nothing was measured")
        return {
            "open_s": store["wall_s"],
            "open_cpu_s": store["cpu_s"],
            "process_s": process_s,
            "tail_rows": rows - store["snapshot_row"],
            "journal_mb": (Path(path) / JOURNAL_FILE).stat().st_size / MB,
            "snapshot_mb": sum(file.stat().st_size for file in Path(path).glob("snapshot-*")) / MB,
        }


def open_store(folder: Path) -> Figures:
    """Open a store."""
    from mapserver import server  # noqa: F401 # a server's imports count in the time of the process

    opened: list[Store] = []
    took = timed(lambda: opened.append(Store(JournalLocation(folder), SITE, CONFIG, lambda: START_NS)))
    (store,) = opened
    rows = {"journalled": store.journalled, "merged": store.merged, "snapshot_row": store.snapshot_row}
    store.close()
    return took | rows


def fold(folder: Path, threads: int) -> Figures:
    """Fold a whole journal; RuntimeError if samples are missing."""
    warm_up(CONFIG.fold)
    grid = Grid(SITE.cell_m, CONFIG.fold)
    with JournalLocation(folder).reader() as journal:
        history = History(journal, JournalLocation(folder).archive)
        took = timed(lambda: fold_history(grid, history, threads=threads))
        sent = sum(watermark.seq for watermark in journal.watermarks().values())
    if (samples := grid.folded + grid.skipped) != sent:
        raise RuntimeError(f"{samples} of {sent} samples are in the grid: nothing was measured")
    return took | {"peak_mb": memory_mb("VmHWM"), "samples": samples}


def fill(hours: float) -> Figures:
    """Fold `hours` of work in this process, write the grid and read it.

    bytes_per_cell_and_bucket: of pages with one bucket; evidence_mb: all pages.
    """
    from mapserver import server  # noqa: F401 # zenoh, sqlite and the plotter's libraries are resident as well

    grid = Grid(SITE.cell_m, CONFIG.fold)
    for name, rows in islice(batches(), samples_of(hours) // BATCH):
        grid.fold(rows, name)
    resident_mb = memory_mb()
    blocks = [record for _, _, record in grid.state().blocks]
    evidence_bytes, pages = sum(map(sys.getsizeof, blocks)), sum(len(Pages.unpacked(record).cells) for record in blocks)
    return {
        "samples": grid.folded,
        "cells": grid.known_cells(),
        "bytes_per_cell_and_bucket": evidence_bytes / max(1, pages),
        "evidence_mb": evidence_bytes / MB,
        "resident_mb": max(resident_mb, memory_mb()),  # settled, or with pending pages
        **_snapshot(grid),
    }


def _snapshot(grid: Grid) -> Figures:
    with tempfile.TemporaryDirectory() as folder:
        past, loaded = StorePast.of_store(Path(folder), grid.cell_m, grid.config), list[Grid]()
        saved = timed(lambda: save_snapshot(Path(folder), 1, {}, grid.state()))
        peak_mb, path = memory_mb("VmHWM"), snapshot_path(Path(folder), 1)

        def load() -> None:
            with Checkpoint(path) as checkpoint:
                loaded.append(past.grid(checkpoint))

        read = timed(load)
        size_mb = path.stat().st_size / MB
    return {"peak_mb": peak_mb, "snapshot_mb": size_mb, "save_s": saved["wall_s"], "load_s": read["wall_s"]}


def served(hours: float) -> Figures:
    """Memory of a real server."""
    rows, options = samples_of(hours) // BATCH, f"{STORE_OPTIONS}snapshot_s = {SNAPSHOT_S}\n"
    with tempfile.TemporaryDirectory() as path, Site(Path(path), options=options) as site:
        write_store(Path(path), SITE, rows, tail_rows=0)
        with site.serving() as pid, session(site.endpoint) as link:
            ask(link, keys.map_query(SITE.name, "region") + "?bounds=0,0,1000,1000;layers=resistance,grade")
            machines = keys.map_query(SITE.name, "machines")
            wait_until(lambda: _are_judged(ask(link, machines)[0]), DEADLINE_S, "the judgement of all machines")
            rest_mb = forget_peak_mb(pid)
            name, more = next(islice(batches(), rows, None))
            send(link, SampleBatch(name, 2, 1, more, SITE.frame))
            wait_until(snapshot_path(Path(path), rows + 1).exists, DEADLINE_S, "a snapshot")
            most_mb = memory_mb("VmHWM", pid)
    return {"resident_mb": rest_mb, "with_snapshot_mb": most_mb, "times_with_snapshot": most_mb / rest_mb}


def _are_judged(machines: bytes) -> bool:
    return all("cells" in machine.evidence for machine in decode_machines(machines).machines)


if __name__ == "__main__":
    what, argument, *rest = sys.argv[1:]
    works: dict[str, Callable[[], Figures]] = {
        "open": lambda: open_store(Path(argument)),
        "fold": lambda: fold(Path(argument), int(rest[0])),
        "grid": lambda: fill(float(argument)),
    }
    print(json.dumps(works[what]()))
