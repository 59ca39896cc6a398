"""Write-ahead logs: damage inside against a torn tail, with SQLite as reference."""

from __future__ import annotations

import random
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from protocol.disk.write_ahead_log import FRAME_HEADER, HEADER, LogScan, scan

FRAME = FRAME_HEADER + 4096


def open_database(path: Path, page_size: int = 4096) -> sqlite3.Connection:
    db = sqlite3.connect(path, isolation_level=None)
    for pragma in (f"page_size={page_size}", "journal_mode=WAL", "synchronous=FULL", "wal_autocheckpoint=0"):
        db.execute(f"PRAGMA {pragma}")
    db.execute("CREATE TABLE t (b BLOB)")
    return db


@pytest.fixture
def db(tmp_path: Path) -> Iterator[sqlite3.Connection]:
    with closing(open_database(tmp_path / "t.db")) as db:
        yield db


def fill(db: sqlite3.Connection, rng: random.Random, rows: int) -> None:
    for _ in range(rows):
        db.execute("INSERT INTO t VALUES (?)", (rng.randbytes(rng.randint(10, 9000)),))


def log_of(folder: Path) -> bytes:
    return (folder / "t.db-wal").read_bytes()


def recovered_rows(folder: Path, log: bytes) -> int:
    """Rows recovered by SQLite."""
    copy = folder / "copy"
    copy.mkdir(exist_ok=True)
    (copy / "t.db").write_bytes((folder / "t.db").read_bytes())
    (copy / "t.db-wal").write_bytes(log)
    with closing(sqlite3.connect(copy / "t.db")) as db:
        try:
            return db.execute("SELECT COUNT(*) FROM t").fetchone()[0]
        except sqlite3.OperationalError:  # no table
            return 0


def flipped(log: bytes, at: int, bit: int) -> bytes:
    return log[:at] + bytes([log[at] ^ 1 << bit]) + log[at + 1 :]


@pytest.mark.parametrize("page_size", [512, 4096, 65536])
def test_a_whole_log_is_taken_to_its_end(tmp_path, page_size):
    with closing(open_database(tmp_path / "t.db", page_size)) as db:
        fill(db, random.Random(1), 12)
        log = log_of(tmp_path)
    n = (len(log) - HEADER) // (FRAME_HEADER + page_size)
    assert scan(log) == LogScan(n, n)


def test_no_log_and_an_empty_one_hold_nothing():
    assert scan(b"") == scan(bytes(31)) == scan(bytes(5000)) == LogScan()


def test_every_flip_before_the_last_transaction_is_damage(tmp_path, db):
    rng = random.Random(2)
    fill(db, rng, 15)
    end = len(log_of(tmp_path))
    fill(db, rng, 1)
    log, dropped = log_of(tmp_path), 0
    for _ in range(60):
        at = rng.randrange(end)
        bad = flipped(log, at, rng.randrange(8))
        held = scan(bad)
        assert held.damaged_at is not None, at
        assert held.damaged_at <= at
        dropped += recovered_rows(tmp_path, bad) < 16
    assert dropped == 60, "SQLite itself says nothing, and drops rows each time"


def test_a_flip_in_the_header_is_damage(tmp_path, db):
    fill(db, random.Random(3), 4)
    for at in range(HEADER):
        held = scan(flipped(log_of(tmp_path), at, at % 8))
        assert (held.recovered, held.damaged_at) == (0, 0)
        assert held.frames > 4


def test_a_log_of_any_length_with_a_damaged_header_holds_nothing(tmp_path, db):
    fill(db, random.Random(3), 3)
    log = log_of(tmp_path)
    for end in range(HEADER, len(log), 1000):
        for at in (0, 11, 24):  # magic, page size, checksum
            assert scan(flipped(log[:end], at, 0)).recovered == 0


def test_a_torn_tail_is_no_damage(tmp_path, db):
    """A power cut may lose any part of the last transaction."""
    rng = random.Random(4)
    fill(db, rng, 10)
    end = len(log_of(tmp_path))
    db.execute("INSERT INTO t VALUES (?)", (rng.randbytes(30_000),))
    log = log_of(tmp_path)
    assert (len(log) - end) // FRAME > 6
    for _ in range(200):
        torn = bytearray(log)
        for at in range(end, len(log), 512):
            if rng.random() < 0.3:
                torn[at : at + 512] = bytes(len(torn[at : at + 512]))
        held = scan(bytes(torn[: rng.choice((len(torn), rng.randint(end, len(torn))))]))
        assert held.damaged_at is None
        assert held.recovered >= (end - HEADER) // FRAME


def test_what_rolled_back_transactions_left_is_no_damage(tmp_path, db):
    """Long ones spill pages into the log, partly overwritten by shorter ones."""
    rng = random.Random(5)
    fill(db, rng, 3)
    db.execute("PRAGMA cache_size=2")
    for n in (30, 20, 5):
        before = log_of(tmp_path)
        db.execute("BEGIN")
        fill(db, rng, n)
        db.execute("ROLLBACK")
        assert len(log_of(tmp_path)) >= len(before)
        fill(db, rng, 1)
        assert scan(log_of(tmp_path)).damaged_at is None
    log = log_of(tmp_path)
    assert scan(log).frames > scan(log).recovered
    assert recovered_rows(tmp_path, log) == 6


def test_frames_of_an_earlier_use_are_not_looked_at(tmp_path, db):
    rng = random.Random(7)
    fill(db, rng, 12)
    before = scan(log_of(tmp_path)).frames
    db.execute("PRAGMA wal_checkpoint(RESTART)")
    fill(db, rng, 2)
    log = log_of(tmp_path)
    assert len(log) == HEADER + before * FRAME, "the file is used anew from its start"
    held = scan(log)
    assert held.frames == held.recovered < before
    assert held.damaged_at is None
