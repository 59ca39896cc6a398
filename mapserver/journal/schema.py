"""The tables of the journal. There is one schema: a journal of another one is refused."""

from __future__ import annotations

SCHEMA = 3
# When and where the samples of a row lie is a table of its own: 50 bytes a row, so that a read by time and place passes
# over rows without touching the pages of their payloads. Such a read cannot see that it misses a row where a bit of its
# extent has flipped; so extents have a checksum of their own, which is checked on opening.
TABLES = """
CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE journal (
    row INTEGER PRIMARY KEY AUTOINCREMENT,
    machine TEXT NOT NULL,
    spool_id BLOB NOT NULL,
    first_seq INTEGER NOT NULL,
    n INTEGER NOT NULL,
    received_ns INTEGER NOT NULL,
    first_stamp_ns INTEGER NOT NULL,
    last_stamp_ns INTEGER NOT NULL,
    payload BLOB NOT NULL,
    crc32 INTEGER NOT NULL
);
CREATE INDEX journal_machine ON journal (machine, row);
CREATE TABLE watermark (
    machine TEXT NOT NULL,
    spool_id BLOB NOT NULL,
    seq INTEGER NOT NULL,
    lost INTEGER NOT NULL,
    newest_ns INTEGER NOT NULL,
    crc32 INTEGER NOT NULL,
    PRIMARY KEY (machine, spool_id)
) WITHOUT ROWID;
CREATE TABLE extent (
    row INTEGER PRIMARY KEY,
    first_stamp_ns INTEGER NOT NULL,
    last_stamp_ns INTEGER NOT NULL,
    west_m REAL NOT NULL,
    south_m REAL NOT NULL,
    east_m REAL NOT NULL,
    north_m REAL NOT NULL,
    crc32 INTEGER NOT NULL
);
CREATE TABLE events (
    id INTEGER PRIMARY KEY,
    kind TEXT NOT NULL,
    stamp_ns INTEGER NOT NULL,
    body TEXT NOT NULL,
    crc32 INTEGER NOT NULL
);
"""
