"""`python -m tests.chaos.power_worker spool|store FOLDER SEED STEPS`: work on one file store, with promises.

Runs under the disk shim, which orders the lines of FOLDER/promises with the writes: `+ <spool_id> <seq> <hash>` is on
disk; `? <spool_id> <seq> <hash>` may replace it from here on; `- <spool_id> <seq>`: samples up to it may be deleted
from here on.
"""

from __future__ import annotations

import random
import sqlite3
import sys
from contextlib import suppress
from pathlib import Path

import numpy as np

from agents.delivery.spool import Spool, SpoolConfig
from mapserver.config import ServerConfig
from mapserver.ingest.store import Incoming, Store
from mapserver.journal.location import JournalLocation
from mapserver.journal.shortfall import ROW
from mapserver.journal.sqlite.journal import SqliteJournal
from protocol.arrays import Table
from protocol.errors import StoreError
from protocol.machine.samples import content_hash, empty
from protocol.site.site_config import SiteConfig
from protocol.wire.codec import encode_batch
from protocol.wire.messages import Ack, SampleBatch

PROMISES, SPOOL_FILE, STORE_FOLDER = "promises", "spool.db", "store"
MACHINE, SPOOL_ID = "loader-1", 7
SITE = SiteConfig(name="paper", origin_lat_deg=49.01, origin_lon_deg=8.4)


class Promises:
    """File of promises, exempt from faults."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("ab", buffering=0)

    def close(self) -> None:
        self._file.close()

    def kept(self, spool_id: int, first_seq: int, rows: Table, sign: str = "+") -> None:
        """Promise samples on disk."""
        lines = [f"{sign} {spool_id:x} {first_seq + i} {content_hash(row)}\n" for i, row in enumerate(rows)]
        self._file.write("".join(lines).encode())

    def given_up(self, spool_id: int, upto: int) -> None:
        """Announce deletions."""
        self._file.write(f"- {spool_id:x} {upto}\n".encode())


def drive(rng: np.random.Generator, n: int, first_ns: int) -> Table:
    """Unique samples."""
    rows = empty(n)
    rows["stamp_ns"] = first_ns + np.arange(n)
    rows["x_m"], rows["y_m"] = rng.uniform(0, 60, (2, n))
    rows["cov_xx_m2"] = rows["cov_yy_m2"] = 0.5
    rows["distance_m"], rows["c_rr"], rows["c_rr_var"] = 0.5, rng.uniform(0.01, 0.2, n), 1e-4
    return rows


def use_spool(folder: Path, promises: Promises, seed: int, steps: int, *, careless: bool = False) -> None:
    """Record, finalise and acknowledge at random. careless: with settings that lose rows."""
    rng, chance, spool, waiting = np.random.default_rng(seed), random.Random(seed), None, empty()
    for step in range(steps):
        with suppress(StoreError, sqlite3.Error):  # disk failure: nothing was promised
            spool = spool or Spool(folder / SPOOL_FILE, SpoolConfig())
            _sync(spool._db, careless)
            rows, finals = (
                drive(rng, chance.randint(1, 12), step * 1000),
                waiting[: chance.randint(0, len(waiting))].copy(),
            )
            finals["x_m"] += 0.25
            n, first = chance.choice((0, len(rows))), spool.newest - len(waiting) + 1
            pending = n if len(finals) == len(waiting) else len(rows)
            promises.kept(spool.spool_id, first, finals, "?")
            seq = spool.record(rows, pending=pending, finals=finals)
            promises.kept(spool.spool_id, first, finals)
            promises.kept(spool.spool_id, seq, rows)
            waiting = np.concatenate([waiting[len(finals) :], rows[len(rows) - pending :]])
            if chance.random() < 0.3 and (head := spool.head(chance.randint(1, 30))):
                promises.given_up(head.spool_id, head.first_seq + len(head.rows) - 1)
                spool.acknowledge(head.spool_id, head.first_seq + len(head.rows) - 1)
        if spool and chance.random() < 0.02:
            spool.close()
            spool, waiting = None, empty()
    if spool:
        spool._db.close()  # as after a kill
        spool._mark.close()


def use_store(folder: Path, promises: Promises, seed: int, steps: int, *, careless: bool = False) -> None:
    """Send batches, some twice, with occasional snapshots. careless: as above."""
    rng, chance, store = np.random.default_rng(seed), random.Random(seed), None
    waiting, done = empty(), 0
    for step in range(steps):
        if chance.random() > 0.2:
            waiting = np.concatenate([waiting, drive(rng, chance.randint(1, 40), 1 + step * 1000)])
        with suppress(StoreError, sqlite3.Error, OSError):
            store = store or Store(JournalLocation(folder / STORE_FOLDER), SITE, ServerConfig(), lambda: 10**18)
            _sync(store.journal._db, careless)
            payload = encode_batch(SampleBatch(MACHINE, SPOOL_ID, done + 1, waiting, SITE.frame, 0))
            answers = store.commit([Incoming(MACHINE, payload)] * chance.randint(1, 2))
            if isinstance(answers[0], Ack) and len(waiting):
                promises.kept(SPOOL_ID, done + 1, waiting)
                waiting, done = empty(), done + len(waiting)
            if chance.random() < 0.05:
                store.save_snapshot()
    if store:
        store.journal._db.close()
        store.journal._mark.close()


def mark_before_commit() -> None:
    """Make the journal write its mark too early, claiming what a power cut may remove."""
    commit = SqliteJournal.commit

    def hasty(journal: SqliteJournal) -> None:
        journal._mark.write({ROW: journal.last_row, **journal._changed})
        commit(journal)

    SqliteJournal.commit = hasty  # type: ignore[method-assign]


def _sync(db: sqlite3.Connection, careless: bool) -> None:
    if careless:
        db.execute("PRAGMA synchronous=NORMAL")


USE = {"spool": use_spool, "store": use_store}

if __name__ == "__main__":
    FOLDER = Path(sys.argv[2])
    if "hasty" in sys.argv:
        mark_before_commit()
    USE[sys.argv[1]](
        FOLDER, Promises(FOLDER / PROMISES), int(sys.argv[3]), int(sys.argv[4]), careless="careless" in sys.argv
    )
