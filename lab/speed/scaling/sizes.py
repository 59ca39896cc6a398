"""Bytes per sample on the link, in the journal and in the archive; and what an agent's link carries in all.

Of a link what TCP carries is counted, with Zenoh's framing, acknowledgements and signs of life; TLS and the headers of
TCP and IP come on top. A table of PostgreSQL is counted with its indices, after a vacuum.
"""

from __future__ import annotations

import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack
from itertools import islice
from pathlib import Path

import numpy as np

from lab.speed.measure import START_NS, Report, in_child, machine
from lab.speed.merge_restart import SITE
from lab.speed.merge_work import drive
from lab.speed.processes import process, send, served, session
from lab.speed.scaling.counted import counted
from mapserver.journal.archive import write_file
from mapserver.journal.location import JOURNAL_FILE, JournalLocation
from mapserver.journal.rows import Admission
from protocol.arrays import Table
from protocol.site.site_file import load_site
from protocol.wire import keys
from protocol.wire.codec import encode_batch
from protocol.wire.messages import SampleBatch
from tests import postgres_server as server

BATCHES = (3, 6, 100)  # samples: a second of a machine, one of a machine at 3 m/s, what waited for half a minute
GROUP = 10  # batches in a commit
SENT = 300  # batches over a link
CONFIG = Path(__file__).parent.parent.parent / "config" / "site.toml"
SPEED = 1  # of the agent's drive: health and acknowledgements are by the clock
LAG_S = 100  # from a place on the road to its sample: what comes before is not the usual traffic


def run(samples: int, seconds: float) -> Report:
    """Write so many samples, and have an agent work for so many seconds.

    Rows: bytes per sample by the samples of a batch: the batch itself, over a link to the server and back, in a journal
    in SQLite and in PostgreSQL. Agent: bytes per second of its link, samples per second, and bytes of each in an
    archive, whose files are compressed: made-up samples would take fewer.
    """
    with tempfile.TemporaryDirectory() as path:
        rows = [_sizes(Path(path) / str(n), n, samples) for n in BATCHES]
        agent = [_agent_link(Path(path) / "agent", seconds)]
    return {"benchmark": "sizes", "samples": samples, "seconds": seconds, **machine(), "rows": rows, "agent": agent}


def _sizes(folder: Path, n: int, samples: int) -> dict[str, float | None]:
    folder.mkdir()
    batches = list(islice(_batches(n), samples // n))
    sent = batches[:SENT]
    up, down = _over_a_link(folder / "link", sent)
    kept = JournalLocation(folder / "sqlite")
    _journal(kept, batches)
    total = n * len(batches)
    journal_b = (kept.folder / JOURNAL_FILE).stat().st_size
    return {
        "samples_in_batch": n,
        "batch": round(len(encode_batch(batches[0])) / n, 1),
        "link_up": round(up / (n * len(sent)), 1),
        "link_down": round(down / (n * len(sent)), 1),
        "journal": round(journal_b / total, 1),
        "postgres": _in_postgres(folder / "postgres", batches, total),
    }


def _batches(n: int) -> Iterator[SampleBatch]:
    """One machine's samples as it drives, in batches of n."""
    first = 1
    waiting: Table | None = None
    for leg in drive(np.random.default_rng(1)):
        rows = leg if waiting is None else np.concatenate([waiting, leg])
        for begin in range(0, len(rows) - n + 1, n):
            yield SampleBatch("loader-1", 1, first, rows[begin : begin + n], SITE.frame)
            first += n
        waiting = rows[len(rows) - len(rows) % n :]


def _over_a_link(folder: Path, batches: list[SampleBatch]) -> tuple[int, int]:
    """Bytes to the router and back for batches that are sent one after the other."""
    folder.mkdir()
    with served(folder, SITE) as (endpoint, _), counted(endpoint) as (near, passed), session(near) as link:
        send(link, SITE, SampleBatch("loader-2", 2, 1, batches[0].rows, SITE.frame))  # which declares all that it needs
        before = Counter(passed)
        for batch in batches:
            send(link, SITE, batch)
        return passed["up"] - before["up"], passed["down"] - before["down"]


def _journal(location: JournalLocation, batches: list[SampleBatch]) -> None:
    journal = location.open(SITE.name, SITE.frame)
    for first in range(0, len(batches), GROUP):
        journal.begin()
        for batch in batches[first : first + GROUP]:
            journal.append(Admission(batch, trimmed=0, lost=0), START_NS)
        journal.commit()
    journal.close()


def _in_postgres(folder: Path, batches: list[SampleBatch], total: int) -> float | None:
    """Bytes per sample in a database, and none where PostgreSQL is not installed."""
    try:
        with server.cluster() as cluster:
            database = cluster.new_database()
            _journal(JournalLocation(folder, database.url), batches)
            database.sql("VACUUM")
            query = (
                "SELECT sum(pg_total_relation_size(oid)) FROM pg_class WHERE relnamespace = 'sitegrid'::regnamespace"
            )
            ((size,),) = database.sql(f"{query} AND relkind = 'r'")
            return round(float(size) / total, 1)
    except RuntimeError:
        return None


def _archived(location: JournalLocation) -> Path:
    """All of a journal as one file."""
    with location.reader() as journal:
        rows = ((row, START_NS) for row in journal.read())
        path = write_file(location.archive.folder, journal.identity().id, SITE, rows)
    if path is None:
        raise RuntimeError("the journal is empty: nothing was measured")
    return path


def _agent_link(folder: Path, seconds: float) -> dict[str, float]:
    """Bytes per second of the link of an agent whose sensors are on the machine, and what became of its samples.

    Somebody listens to its pose and health: what nobody asks for is never sent.
    """
    folder.mkdir()
    log, store, until_s = folder / "log", folder / "store", LAG_S + seconds * SPEED
    store.mkdir()
    words = ("--record", log, "--machines", 1, "--seconds", until_s + LAG_S, "--speed", 0)
    in_child("sitegrid.cli", "sim", *map(str, words))
    site = load_site(CONFIG)
    with ExitStack() as opened:
        endpoint, _ = opened.enter_context(served(store, site))
        near, passed = opened.enter_context(counted(endpoint))
        listener = opened.enter_context(session(endpoint))
        for key in (keys.poses_all(site.name), keys.health_all(site.name)):
            listener.declare_subscriber(key, lambda _: None)
        replay = ("--driver", "replay", "--log", log / "loader-1" / "log.toml", "--speed", SPEED)
        options = ("--endpoint", near, "--spool", folder / "spool.db", *replay)
        opened.enter_context(process("sitegrid.cli", "agent", *map(str, options)))
        time.sleep(LAG_S / SPEED)
        before, had, began_s = Counter(passed), _acknowledged(store), time.monotonic()
        time.sleep(seconds)
        after, has, took_s = Counter(passed), _acknowledged(store), time.monotonic() - began_s
    samples = _acknowledged(store)
    return {
        "up_b_per_s": round((after["up"] - before["up"]) / took_s, 1),
        "down_b_per_s": round((after["down"] - before["down"]) / took_s, 1),
        "samples_per_s": round((has - had) / took_s, 2),
        "archive_b_per_sample": round(_archived(JournalLocation(store)).stat().st_size / samples, 1),
    }


def _acknowledged(store: Path) -> int:
    with JournalLocation(store).reader() as journal:
        return sum(mark.seq for mark in journal.watermarks().values())
