"""Samples per second from a machine's bytes to the grid: decode, check, commit to disk (FULL), fold."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable
from pathlib import Path

from benchmarks.measure import START_NS, Report, machine, medians, timed, track
from mapserver.config import ServerConfig
from mapserver.ingest.store import Incoming, Store
from protocol.arrays import Table
from protocol.site.site_config import SiteConfig
from protocol.wire.codec import encode_batch
from protocol.wire.messages import Ack, SampleBatch

SITE = SiteConfig("bench", 48.0, 11.0)
BATCHES = (100, 1000)
GROUPS = (1, 16)  # batches in one commit: a single machine waiting for its answer, and many at once


def run(samples: int, runs: int) -> Report:
    """Measure every size of batch and group, each run on a new store."""
    rows = track(samples)
    with tempfile.TemporaryDirectory() as folder:
        Store(Path(folder) / "warm", SITE, ServerConfig(), lambda: START_NS).grid.fold(rows[:1], "loader-1")  # compiled
        cases = {f"{size} {group}": (size, group) for size in BATCHES for group in GROUPS}
        variants = {name: _variant(Path(folder), name, rows, *case) for name, case in cases.items()}
        seconds = medians(variants, runs)
    figures = [
        {
            "batch": size,
            "batches_per_commit": group,
            "samples_per_s": round(samples / seconds[name]),
            "ms_per_commit": round(seconds[name] / math.ceil(math.ceil(samples / size) / group) * 1e3, 3),
        }
        for name, (size, group) in cases.items()
    ]
    return {"benchmark": "ingest", "samples": samples, "runs": runs, **machine(), "rows": figures}


def _variant(folder: Path, name: str, rows: Table, size: int, group: int) -> Callable[[], float]:
    """Send all samples through a new store; the clock runs from the first byte to the last acknowledgement."""
    sent = (SampleBatch("loader-1", 1, i + 1, rows[i : i + size], SITE.frame) for i in range(0, len(rows), size))
    batches = [Incoming(batch.machine, encode_batch(batch)) for batch in sent]
    groups = [batches[first : first + group] for first in range(0, len(batches), group)]

    def work() -> float:
        with tempfile.TemporaryDirectory(dir=folder, prefix=name.replace(" ", "-")) as path:
            store = Store(Path(path), SITE, ServerConfig(), lambda: START_NS)
            seconds = timed(lambda: _take(store, groups))
            store.close()
        return seconds

    return work


def _take(store: Store, groups: list[list[Incoming]]) -> None:
    for group in groups:
        if not all(isinstance(answer, Ack) for answer in store.commit(group)):
            raise RuntimeError("the store refused a batch")
