"""Samples per second from a machine's bytes to the grid: decode, check, commit to disk (FULL), fold.

On SQLite and, where its server is installed, on PostgreSQL, alone and with a synchronous replica on the same disk.
"""

from __future__ import annotations

import math
import statistics
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from lab.speed.measure import START_NS, Report, machine, medians, timed, track
from mapserver.config import ServerConfig
from mapserver.ingest.store import Incoming, Store
from mapserver.journal.location import JournalLocation
from mapserver.server import warm_up
from protocol.arrays import Table
from protocol.site.site_config import SiteConfig
from protocol.wire.codec import encode_batch
from protocol.wire.messages import Ack, SampleBatch
from tests import postgres_server as server

SITE = SiteConfig("bench", 48.0, 11.0)
NewUrl = Callable[[], str]
BATCHES = (6, 100, 1000)  # samples: a second of a machine with a good link, half a minute of it, a backlog
GROUPS = (1, 16)  # batches in one commit: a single machine waiting for its answer, and many at once


def run(samples: int, runs: int) -> Report:
    """Measure every size of batch and group, each run on a new store."""
    rows = track(samples)
    with tempfile.TemporaryDirectory() as folder, ExitStack() as opened:
        warm_up(ServerConfig())
        databases, missing = _databases(opened)
        cases = {
            f"{journal} {size} {group}": (journal, size, group)
            for size in BATCHES
            for group in GROUPS
            for journal in databases
        }
        cpu_s: dict[str, list[float]] = {name: [] for name in cases}
        variants = {
            name: _variant(Path(folder), rows, case[1:], cpu_s[name], databases[case[0]])
            for name, case in cases.items()
        }
        seconds = medians(variants, runs)
    figures = [
        {
            "journal": journal,
            "batch": size,
            "batches_per_commit": group,
            "samples_per_s": round(samples / seconds[name]),
            "samples_per_cpu_s": round(samples / statistics.median(cpu_s[name])),
            "ms_per_commit": round(seconds[name] / math.ceil(math.ceil(samples / size) / group) * 1e3, 3),
            "of_sqlite": round(seconds[f"sqlite {size} {group}"] / seconds[name], 2),
        }
        for name, (journal, size, group) in cases.items()
    ]
    report = {"benchmark": "ingest", "samples": samples, "runs": runs, **machine(), "rows": figures}
    return report | {"missing": missing}


def _databases(opened: ExitStack) -> tuple[dict[str, NewUrl], dict[str, str]]:
    """What makes the URL of a new journal, by the name of what keeps it; and what is not measured, and why."""
    there: dict[str, NewUrl] = {"sqlite": lambda: ""}
    try:
        primary = opened.enter_context(server.cluster())
        there["postgres"] = lambda: primary.new_database().url
        replicated = opened.enter_context(server.cluster())
        opened.enter_context(server.replica(replicated, "b"))
        replicated.sql("ALTER SYSTEM SET synchronous_standby_names = 'b'")
        replicated.sql("SELECT pg_reload_conf()")
        there["postgres, synchronous replica"] = lambda: replicated.new_database().url
    except RuntimeError as error:
        return there, {"postgres": str(error)}
    return there, {}


def _variant(
    folder: Path, rows: Table, case: tuple[int, int], cpu_s: list[float], new_url: NewUrl
) -> Callable[[], float]:
    """Send all samples through a new store; clocks run from the first byte until all samples are in the map.

    cpu_s: takes the processor time of each run.
    """
    size, group = case
    sent = (SampleBatch("loader-1", 1, i + 1, rows[i : i + size], SITE.frame) for i in range(0, len(rows), size))
    batches = [Incoming(batch.machine, encode_batch(batch)) for batch in sent]
    groups = [batches[first : first + group] for first in range(0, len(batches), group)]

    def work() -> float:
        with tempfile.TemporaryDirectory(dir=folder) as path:
            store = Store(JournalLocation(Path(path), new_url()), SITE, ServerConfig(), lambda: START_NS)
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
