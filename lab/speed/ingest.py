"""Samples from wire bytes to grid (decode, check, commit to disk, fold), and their bytes in the journal.

On SQLite and, if installed, PostgreSQL, alone and with a synchronous replica on the same disk.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from itertools import islice
from pathlib import Path

import numpy as np

from lab.speed.measure import in_turn, rows_of, say, timed, track
from lab.speed.site import SITE
from mapserver.config import ServerConfig
from mapserver.ingest.store import Incoming, Store
from mapserver.journal.location import JOURNAL_FILE, JournalLocation
from mapserver.server import warm_up
from protocol.arrays import Table
from protocol.wire.codec import encode_batch
from protocol.wire.messages import Ack, SampleBatch
from sitegrid.proof.figures import Row
from tests import postgres_server as postgres
from tests.site_work import LEG_SAMPLES, START_NS, drive

OPTIONS = {"runs": 5, "samples": 20_000}
SQLITE, POSTGRES, REPLICATED = "SQLite", "PostgreSQL", "PostgreSQL, synchronous replica"
GOALS = {
    (f"{POSTGRES}, 100 in a batch, 16 in a commit", "of_sqlite"): ">= 0.5",
    (f"{REPLICATED}, 100 in a batch, 16 in a commit", "of_sqlite"): ">= 0.4",
}
BATCHES = (6, 100, 1000)  # samples: a second of a machine on a good link, half a minute, a backlog
GROUPS = (1, 16)  # batches per commit: one waiting machine, many at once
SMALLEST, GROUP = 3, 10  # samples per batch at 3 m/s, batches per commit: bytes in the journal
TABLES = "SELECT sum(pg_total_relation_size(oid)) FROM pg_class WHERE relkind = 'r' AND relnamespace = "


def run(samples: int, runs: int) -> Iterator[Row]:
    """Every journal with every batch and group size, on new stores in turn; None if not installed.

    of_sqlite: throughput relative to SQLite. journal_b_per_sample: batches of 3; databases with indices, after a
    vacuum.
    """
    rows = track(samples)
    with tempfile.TemporaryDirectory() as folder, ExitStack() as opened:
        warm_up(ServerConfig())
        urls = _journals(opened)
        cases = {
            f"{journal}, {size} in a batch, {group} in a commit": (journal, size, group)
            for size in BATCHES
            for group in GROUPS
            for journal in urls
        }
        variants = {
            name: partial(_taken, Path(folder), _groups(rows, size, group), urls[journal])
            for name, (journal, size, group) in cases.items()
        }
        took = in_turn(variants, runs)
        for name, (_, size, group) in cases.items():
            figures = {
                "samples_per_s": samples / took[name]["wall_s"],
                "samples_per_cpu_s": samples / took[name]["cpu_s"],
                "ms_per_commit": took[name]["wall_s"] / math.ceil(math.ceil(samples / size) / group) * 1e3,
                "of_sqlite": took[f"{SQLITE}, {size} in a batch, {group} in a commit"]["wall_s"] / took[name]["wall_s"],
            }
            yield from rows_of(name, figures)
        yield from rows_of(SQLITE, {"journal_b_per_sample": _sqlite_bytes(Path(folder), samples)})
        yield from rows_of(POSTGRES, {"journal_b_per_sample": _postgres_bytes(Path(folder), samples, urls)})


def _journals(opened: ExitStack) -> dict[str, Callable[[], str]]:
    """Factories of new journal URLs, by journal type."""
    there: dict[str, Callable[[], str]] = {SQLITE: lambda: ""}
    try:
        primary = opened.enter_context(postgres.cluster())
        there[POSTGRES] = lambda: primary.new_database().url
        replicated = opened.enter_context(postgres.cluster())
        opened.enter_context(postgres.replica(replicated, "b"))
        replicated.sql("ALTER SYSTEM SET synchronous_standby_names = 'b'")
        replicated.sql("SELECT pg_reload_conf()")
        there[REPLICATED] = lambda: replicated.new_database().url
    except RuntimeError as error:
        say(f"not measured: PostgreSQL; {error}")
    return there


def _groups(rows: Table, size: int, group: int) -> list[list[Incoming]]:
    sent = (SampleBatch("loader-1", 1, i + 1, rows[i : i + size], SITE.frame) for i in range(0, len(rows), size))
    batches = [Incoming(batch.machine, encode_batch(batch)) for batch in sent]
    return [batches[first : first + group] for first in range(0, len(batches), group)]


def _taken(folder: Path, groups: list[list[Incoming]], new_url: Callable[[], str]) -> dict[str, float]:
    """Send all samples through a new store; timed from the first byte to the complete map."""
    with tempfile.TemporaryDirectory(dir=folder) as path:
        store = Store(JournalLocation(Path(path), new_url()), SITE, ServerConfig(), lambda: START_NS)
        took = timed(lambda: _take(store, groups))
        store.close()
    return took


def _take(store: Store, groups: list[list[Incoming]]) -> None:
    for group in groups:
        if not all(isinstance(answer, Ack) for answer in store.commit(group)):
            raise RuntimeError("the store refused a batch")
    store.grid.known_cells()  # folds pending samples


def _fill(location: JournalLocation, samples: int) -> None:
    rows = np.concatenate(list(islice(drive(np.random.default_rng(1)), 1 + samples // LEG_SAMPLES)))
    store = Store(location, SITE, ServerConfig(), lambda: START_NS)
    _take(store, _groups(rows[:samples], SMALLEST, GROUP))
    store.close()


def _sqlite_bytes(folder: Path, samples: int) -> float:
    _fill(JournalLocation(folder / "bytes"), samples)
    return (folder / "bytes" / JOURNAL_FILE).stat().st_size / samples


def _postgres_bytes(folder: Path, samples: int, urls: dict[str, Callable[[], str]]) -> float | None:
    """None if PostgreSQL is not installed."""
    if POSTGRES not in urls:
        return None
    with postgres.cluster() as cluster:
        database = cluster.new_database()
        _fill(JournalLocation(folder / "rows", database.url), samples)
        database.sql("VACUUM")
        ((size,),) = database.sql(f"{TABLES} 'sitegrid'::regnamespace")
        return float(size) / samples
