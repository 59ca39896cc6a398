"""The tables of the journal, and how a journal of an older schema becomes one of this schema, or is read as one.

Statements call `checksum` and `extent_checksum` of journal_rows.py, which the connection brings along.
"""

# ruff: noqa: S608 - statements are put together from constants, never from input

from __future__ import annotations

SCHEMA = 3
# When and where the samples of a row lie is a table of its own: 50 bytes a row, so that a read by time and place passes
# over rows without touching the pages of their payloads. A box that is NULL is not known. What reads by it does not see
# that a row is wanted where a bit of it has flipped, so it has a checksum of its own, which is looked at on opening.
EXTENT = """
CREATE TABLE extent (
    row INTEGER PRIMARY KEY,
    first_stamp_ns INTEGER NOT NULL,
    last_stamp_ns INTEGER NOT NULL,
    west_m REAL,
    south_m REAL,
    east_m REAL,
    north_m REAL,
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
EXTENT_VALUES = ("row", "first_stamp_ns", "last_stamp_ns", "west_m", "south_m", "east_m", "north_m")
_EXTENT_CRC32 = f"extent_checksum({', '.join(EXTENT_VALUES)})"
_EVENT_VALUES = "id, kind, stamp_ns, body"
_PLACED = f"{', '.join(EXTENT_VALUES)}, {_EXTENT_CRC32} AS crc32"
_UNPLACED = f"""SELECT {_PLACED} FROM
    (SELECT row, first_stamp_ns, last_stamp_ns, NULL AS west_m, NULL AS south_m, NULL AS east_m, NULL AS north_m
    FROM main.journal)"""
# What brings a journal up to this schema, by the schema that it has.
UPGRADES = {
    "1": f"""
BEGIN IMMEDIATE;
{EXTENT}
INSERT INTO extent {_UNPLACED};
ALTER TABLE watermark ADD COLUMN newest_ns INTEGER NOT NULL DEFAULT 0;
ALTER TABLE watermark ADD COLUMN crc32 INTEGER;
INSERT INTO meta SELECT 'plain_until', COALESCE(MAX(row), 0) FROM journal;
UPDATE watermark SET newest_ns = newest FROM
    (SELECT machine AS m, spool_id AS s, MAX(last_stamp_ns) AS newest FROM journal GROUP BY machine, spool_id)
    WHERE m = machine AND s = spool_id;
UPDATE meta SET value = '{SCHEMA}' WHERE key = 'schema';
COMMIT;
""",
    "2": f"""
BEGIN IMMEDIATE;
ALTER TABLE extent ADD COLUMN crc32 INTEGER;
ALTER TABLE events ADD COLUMN crc32 INTEGER;
UPDATE extent SET crc32 = {_EXTENT_CRC32};
UPDATE events SET crc32 = checksum({_EVENT_VALUES});
UPDATE meta SET value = '{SCHEMA}' WHERE key = 'schema';
COMMIT;
""",
}
# What a reader, which may not write, puts over a journal of an older schema.
SEEN = {
    "1": f"""
CREATE TEMP VIEW extent AS {_UNPLACED};
CREATE TEMP VIEW watermark AS SELECT machine, spool_id, seq, lost,
    (SELECT COALESCE(MAX(last_stamp_ns), 0) FROM main.journal) AS newest_ns, NULL AS crc32 FROM main.watermark;
CREATE TEMP TABLE events (id INTEGER PRIMARY KEY, kind TEXT, stamp_ns INTEGER, body TEXT, crc32 INTEGER);
""",
    "2": f"""
CREATE TEMP VIEW extent AS SELECT {_PLACED} FROM main.extent;
CREATE TEMP VIEW events AS SELECT {_EVENT_VALUES}, checksum({_EVENT_VALUES}) AS crc32 FROM main.events;
""",
}
