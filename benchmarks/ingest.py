"""Samples per second from a machine's bytes to the grid: decode, check, commit to disk (FULL), fold."""

from __future__ import annotations

import math
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from benchmarks.measure import START_NS, Report, machine, medians, timed, track
from mapserver.config import ServerConfig
from mapserver.ingest.store import Incoming, Store
from mapserver.journal.location import JournalLocation
from mapserver.server import warm_up
from protocol.arrays import Table
from protocol.site.site_config import SiteConfig
from protocol.wire.codec import encode_batch
from protocol.wire.messages import Ack, SampleBatch

SITE = SiteConfig("bench", 48.0, 11.0)
BATCHES = (6, 100, 1000)  # samples: a second of a machine with a good link, half a minute of it, a backlog
GROUPS = (1, 16)  # batches in one commit: a single machine waiting for its answer, and many at once


def run(samples: int, runs: int) -> Report:
    """Measure every size of batch and group, each run on a new store."""
    rows = track(samples)
    with tempfile.TemporaryDirectory() as folder:
        warm_up(ServerConfig())
        cases = {f"{size} {group}": (size, group) for size in BATCHES for group in GROUPS}
        cpu_s: dict[str, list[float]] = {name: [] for name in cases}
        variants = {name: _variant(Path(folder), rows, case, cpu_s[name]) for name, case in cases.items()}
        seconds = medians(variants, runs)
    figures = [
        {
            "batch": size,
            "batches_per_commit": group,
            "samples_per_s": round(samples / seconds[name]),
            "samples_per_cpu_s": round(samples / statistics.median(cpu_s[name])),
            "ms_per_commit": round(seconds[name] / math.ceil(math.ceil(samples / size) / group) * 1e3, 3),
        }
        for name, (size, group) in cases.items()
    ]
    return {"benchmark": "ingest", "samples": samples, "runs": runs, **machine(), "rows": figures}


def _variant(folder: Path, rows: Table, case: tuple[int, int], cpu_s: list[float]) -> Callable[[], float]:
    """Send all samples through a new store; clocks run from the first byte until all samples are in the map.

    cpu_s: takes the processor time of each run.
    """
    size, group = case
    sent = (SampleBatch("loader-1", 1, i + 1, rows[i : i + size], SITE.frame) for i in range(0, len(rows), size))
    batches = [Incoming(batch.machine, encode_batch(batch)) for batch in sent]
    groups = [batches[first : first + group] for first in range(0, len(batches), group)]

    def work() -> float:
        with tempfile.TemporaryDirectory(dir=folder) as path:
            store = Store(JournalLocation(Path(path)), SITE, ServerConfig(), lambda: START_NS)
            start_cpu_s = time.process_time()
            seconds = timed(lambda: _take(store, groups))
            cpu_s.append(time.process_time() - start_cpu_s)
            store.close()
        return seconds

    return work


def _take(store: Store, groups: list[list[Incoming]]) -> None:
    for group in groups:
        if not all(isinstance(answer, Ack) for answer in store.commit(group)):
            raise RuntimeError("the store refused a batch")
    store.grid.known_cells()  # folds what waits
