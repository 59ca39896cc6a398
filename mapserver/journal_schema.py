"""The tables of the journal, and how a journal of schema 1 becomes one of schema 2, or is read as one."""

# ruff: noqa: S608 - statements are put together from constants, never from input

from __future__ import annotations

SCHEMA = 2
# When and where the samples of a row lie is a table of its own: 50 bytes a row, so that a read by time and place passes
# over rows without touching the pages of their payloads. A box that is NULL is not known.
EXTENT = """
CREATE TABLE extent (
    row INTEGER PRIMARY KEY,
    first_stamp_ns INTEGER NOT NULL,
    last_stamp_ns INTEGER NOT NULL,
    west_m REAL,
    south_m REAL,
    east_m REAL,
    north_m REAL
);
CREATE TABLE events (id INTEGER PRIMARY KEY, kind TEXT NOT NULL, stamp_ns INTEGER NOT NULL, body TEXT NOT NULL);
"""
TABLES = f"""
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
    newest_ns INTEGER NOT NULL DEFAULT 0,
    crc32 INTEGER,
    PRIMARY KEY (machine, spool_id)
) WITHOUT ROWID;
{EXTENT}"""
OLD_EXTENT = "SELECT row, first_stamp_ns, last_stamp_ns, NULL, NULL, NULL, NULL FROM journal"
FROM_SCHEMA_1 = f"""
BEGIN IMMEDIATE;
{EXTENT}
INSERT INTO extent {OLD_EXTENT};
ALTER TABLE watermark ADD COLUMN newest_ns INTEGER NOT NULL DEFAULT 0;
ALTER TABLE watermark ADD COLUMN crc32 INTEGER;
INSERT INTO meta SELECT 'plain_until', COALESCE(MAX(row), 0) FROM journal;
UPDATE watermark SET newest_ns = newest FROM
    (SELECT machine AS m, spool_id AS s, MAX(last_stamp_ns) AS newest FROM journal GROUP BY machine, spool_id)
    WHERE m = machine AND s = spool_id;
UPDATE meta SET value = '2' WHERE key = 'schema';
COMMIT;
"""
# What a reader, which may not write, puts over a journal of schema 1.
SEEN_FROM_SCHEMA_1 = f"""
CREATE TEMP VIEW extent (row, first_stamp_ns, last_stamp_ns, west_m, south_m, east_m, north_m) AS {OLD_EXTENT};
CREATE TEMP VIEW watermark AS SELECT machine, spool_id, seq, lost,
    (SELECT COALESCE(MAX(last_stamp_ns), 0) FROM main.journal) AS newest_ns, NULL AS crc32 FROM main.watermark;
CREATE TEMP TABLE events (id INTEGER PRIMARY KEY, kind TEXT, stamp_ns INTEGER, body TEXT);
"""
