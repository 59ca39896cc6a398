"""Duration of `sitegrid fold` on an archive: one thread, two threads, Dask workers.

Each variant is the whole command, in turn: `python -m lab.speed.archive VARIANT ARCHIVE STORE`. The archive is fresh,
thus in the file cache. Snapshot hashes are compared.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

from lab.speed.measure import ROOT, Figures, in_child, in_turn, rows_of, say
from lab.speed.site import SITE
from mapserver.journal.archive import write_file
from mapserver.journal.rows import JournalRow
from protocol.units import HOUR_NS
from sitegrid.proof.figures import Row
from tests.site_work import BATCH, batches, evidence_hash

STORE = "0123456789abcdef"
WORKERS = 2
OPTIONS = {"samples": 50_000_000, "runs": 1}
GOALS = {("jobs", "times_one_thread"): ">= 1.6"}
VARIANTS = ("thread", "threads", "jobs")


def run(samples: int, runs: int) -> Iterator[Row]:
    """An archive in hourly files of ten machines' work, folded by every variant in turn.

    One thread, two threads, two local Dask workers. wall_s; cpu_s: of all processes; times_one_thread: speed-up.
    RuntimeError if maps differ.
    """
    with tempfile.TemporaryDirectory() as path:
        folder, hashes = Path(path), set[str]()
        say(f"an archive of {samples} samples is written")
        _write(folder / "archive", samples)

        def folded(name: str) -> Figures:
            say(f"it is folded: {name}")
            with tempfile.TemporaryDirectory(dir=folder) as out:
                figures = in_child("lab.speed.archive", name, str(folder / "archive"), f"{out}/map")
            hashes.add(figures.pop("hash"))
            return figures

        took = in_turn({name: partial(folded, name) for name in VARIANTS}, runs)
    if len(hashes) != 1:
        raise RuntimeError(f"the maps differ: {hashes}")
    for name, figures in took.items():
        yield from rows_of(name, {**figures, "times_one_thread": took["thread"]["wall_s"] / figures["wall_s"]})


def _write(folder: Path, samples: int) -> None:
    """Write an archive by hours of reception, each row received at its last stamp."""
    hour: list[tuple[JournalRow, int]] = []
    for row in _rows(samples):
        if hour and row.received_ns // HOUR_NS != hour[0][1] // HOUR_NS:
            write_file(folder, STORE, SITE, iter(hour))
            hour = []
        hour.append((row, row.received_ns))
    write_file(folder, STORE, SITE, iter(hour))


def _rows(samples: int) -> Iterator[JournalRow]:
    sent: Counter[str] = Counter()
    for number, (name, batch) in enumerate(islice(batches(), max(1, samples // BATCH)), start=1):
        yield JournalRow(number, name, 1, sent[name] + 1, batch, int(batch["stamp_ns"][-1]))
        sent[name] += len(batch)


def fold_timed(variant: str, archive: Path, out: Path) -> dict[str, Any]:
    """Fold with one variant."""
    if variant == "thread":
        os.sched_setaffinity(0, list(os.sched_getaffinity(0))[:1])  # fold respects it
    words = ["--jobs", str(WORKERS)] if variant == "jobs" else []
    command = [sys.executable, "-m", "sitegrid.cli", "fold", str(archive), "--out", str(out), "--json", *words]
    start_s = time.perf_counter()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, cwd=ROOT)  # noqa: S603
    wall_s = time.perf_counter() - start_s
    usage = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    (snapshot,) = out.glob("snapshot-*")
    return {
        "wall_s": wall_s,
        "cpu_s": sum(each.ru_utime + each.ru_stime for each in usage),
        "peak_mb": max(each.ru_maxrss for each in usage) * 1024 / 1e6,
        "hash": evidence_hash(snapshot),
    }


if __name__ == "__main__":
    print(json.dumps(fold_timed(sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3]))))
