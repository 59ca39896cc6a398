"""Connections to PostgreSQL, and its errors in one line."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import psycopg
from psycopg import conninfo

from protocol.errors import ConfigError, StoreError

Connection = psycopg.Connection[tuple[Any, ...]]
SCHEMA = "sitegrid"  # PostgreSQL schema of the tables
MISSING = ("3D000", "3F000", "42P01")  # SQLSTATEs: no such database, schema, table
REPLICAS = """SELECT current_setting('synchronous_standby_names') <> '',
(SELECT count(*) FROM pg_stat_replication)"""
# Reset limits that would end idle sessions and long reads; which exist depends on the version.
_SET_UP = f"""SET search_path = {SCHEMA}; SET standard_conforming_strings = on;
SELECT set_config(name, '0', false) FROM pg_settings
WHERE name IN ('idle_session_timeout', 'statement_timeout', 'lock_timeout', 'transaction_timeout')"""  # noqa: S608
# A vanished server is noticed after three to four seconds.
DEFAULTS = {
    "connect_timeout": "3",
    "keepalives_idle": "1",
    "keepalives_interval": "1",
    "keepalives_count": "2",
    "tcp_user_timeout": "3000",
}


def shown(url: str) -> str:
    """A URL without its password; ConfigError for no URL."""
    try:
        parts = conninfo.conninfo_to_dict(url)
    except psycopg.Error as error:
        raise ConfigError("--journal", f"is no PostgreSQL URL: {line(error)}") from None
    host, port = (str(parts.get(name) or "") for name in ("host", "port"))
    user = f"{parts['user']}@" if parts.get("user") else ""
    places = zip(host.split(","), (port.split(",") * (host.count(",") + 1))[: host.count(",") + 1], strict=True)
    hosts = ",".join(f"{name}:{number}" if number else name for name, number in places)
    return f"postgresql://{user}{hosts}/{parts.get('dbname') or ''}"


def connect(url: str, role: str, **more: str) -> Connection:
    """Open a connection; raises psycopg.Error. role: shown by the database."""
    given = conninfo.conninfo_to_dict(url)
    settings = {**DEFAULTS, "application_name": f"sitegrid {role}", **given, **more}
    db = psycopg.connect("", autocommit=True, prepare_threshold=None, **settings)  # type: ignore[arg-type]
    try:
        db.execute(_SET_UP)
    except psycopg.Error:
        db.close()
        raise
    return db


def replica_of(*, synchronous: bool, replicas: int) -> str:
    """Replication behind a database's disk, by the answer to REPLICAS."""
    return "synchronous" if synchronous else "asynchronous" if replicas else "none"


def line(error: psycopg.Error) -> str:
    """The database's message in one line."""
    return " ".join(str(error).split()) or type(error).__name__


@contextmanager
def readable(where: str) -> Iterator[None]:
    """Turn database errors into StoreError."""
    try:
        yield
    except psycopg.Error as error:
        if error.sqlstate in MISSING:
            raise StoreError(where, f"holds no journal: {line(error)}; a server makes it when it starts") from None
        raise StoreError(where, f"cannot be read: {line(error)}") from None
