"""Statements with their values in them: a transaction is one message (see session.py)."""

from __future__ import annotations

from collections.abc import Iterable

from psycopg.sql import quote


def insert(table: str, lines: Iterable[tuple[object, ...]], more: str = "") -> str:
    """One statement for all lines; empty without any."""
    values = ",".join(f"({','.join(map(literal, line))})" for line in lines)
    return f"INSERT INTO {table} VALUES {values} {more}" if values else ""  # noqa: S608 # literals, a constant table


def literal(value: object) -> str:
    """A value of plain type as PostgreSQL reads it, where strings conform to the standard."""
    if isinstance(value, bytes):
        return f"'\\x{value.hex()}'"
    return quote(value) if isinstance(value, str) else repr(value)  # numbers
