"""Tables of a journal in PostgreSQL, their creation, and statements with literal values.

A transaction is one message (see session.py).
"""

from __future__ import annotations

from collections.abc import Iterable

from psycopg.sql import quote

from mapserver.journal.postgres.connection import SCHEMA as NAMESPACE
from mapserver.journal.table_writer import new_meta

MAKING = 0x517E62D2  # advisory lock while tables are made
SCHEMA = 4
CHANNEL = "sitegrid_journal"  # notification channel, per database
# Every commit updates the single line of `head`, which numbers rows densely in commit order; a sequence does not, and
# readers would lose rows. `writer`: a name by which an epoch's writer recognises it.
TABLES = """
CREATE TABLE meta (key text PRIMARY KEY, value text NOT NULL, crc32 bigint NOT NULL);
CREATE TABLE head (
    single boolean PRIMARY KEY DEFAULT true CHECK (single),
    epoch bigint NOT NULL, writer text NOT NULL,
    last_row bigint NOT NULL, last_event bigint NOT NULL, archived_row bigint NOT NULL
) WITH (fillfactor = 10);
CREATE TABLE journal (row bigint PRIMARY KEY, record bytea NOT NULL);
ALTER TABLE journal ALTER record SET STORAGE EXTERNAL;
CREATE TABLE watermark (
    machine text, spool_id bytea,
    seq bigint NOT NULL, lost bigint NOT NULL, newest_ns bigint NOT NULL, crc32 bigint NOT NULL,
    PRIMARY KEY (machine, spool_id)
);
CREATE TABLE extent (
    row bigint PRIMARY KEY, first_stamp_ns bigint NOT NULL, last_stamp_ns bigint NOT NULL,
    west_m float8 NOT NULL, south_m float8 NOT NULL, east_m float8 NOT NULL, north_m float8 NOT NULL,
    crc32 bigint NOT NULL
);
CREATE TABLE events (
    id bigint PRIMARY KEY, kind text NOT NULL, stamp_ns bigint NOT NULL, body text NOT NULL, crc32 bigint NOT NULL
);
CREATE FUNCTION advance(mine bigint, from_row bigint, to_row bigint, from_event bigint, to_event bigint)
RETURNS void LANGUAGE plpgsql AS $$
BEGIN
    UPDATE head SET last_row = to_row, last_event = to_event
    WHERE epoch = mine AND last_row = from_row AND last_event = from_event;
    IF NOT FOUND THEN
        RAISE EXCEPTION 'another writer has this journal' USING ERRCODE = 'SG001';
    END IF;
END $$;
"""


def creation(site: str, frame: str, descends: Iterable[str] = ()) -> str:
    """Statement that creates missing tables; of concurrent servers one does."""
    meta = insert("meta", new_meta(SCHEMA, site, frame, descends))
    return f"""DO $making$
BEGIN
    PERFORM pg_advisory_xact_lock({MAKING});
    IF to_regclass('{NAMESPACE}.meta') IS NULL THEN
        CREATE SCHEMA IF NOT EXISTS {NAMESPACE};
        {TABLES}
        INSERT INTO head VALUES (true, 0, '', 0, 0, 0);
        {meta};
    END IF;
END $making$"""  # noqa: S608 # constants, and literals


def insert(table: str, lines: Iterable[tuple[object, ...]], more: str = "") -> str:
    """One statement for all lines; "" for none."""
    values = ",".join(f"({','.join(map(literal, line))})" for line in lines)
    return f"INSERT INTO {table} VALUES {values} {more}" if values else ""  # noqa: S608 # literals, a constant table


def literal(value: object) -> str:
    """A plain value as a PostgreSQL literal, with standard-conforming strings."""
    if isinstance(value, bytes):
        return f"'\\x{value.hex()}'"
    return quote(value) if isinstance(value, str) else repr(value)  # numbers
