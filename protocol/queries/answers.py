"""Answers to map queries, as MessagePack (docs/protocol.md, "Map queries")."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from protocol.arrays import Floats, Floats32
from protocol.errors import MessageError, QueryError, Refusal
from protocol.site.geometry import MAX_CELLS, Bounds
from protocol.wire.codec import MAX_SMALL_BYTES, check_plain, pack, take, take_plain, unpack

MAX_REPLY_BYTES = 2**30
MAX_CELL_M = 1e4
MAX_PLACE_M = 1e7  # from the origin
MAX_ITEMS = 100_000  # of one list


@dataclass(frozen=True)
class PointAnswer:
    """Layer values of the cell with centre (x_m, y_m); NaN is unknown. merged: the journal row it is true for."""

    x_m: float
    y_m: float
    values: Mapping[str, float]
    merged: int
    stamp_ns: int


@dataclass(frozen=True)
class Region:
    """A rectangle of cells.

    x_m (columns,), y_m (rows,): cell centres in `map`, growing east and north. layers: name -> float32 (rows, columns),
    NaN where unknown; row 0 is the southernmost. merged: the journal row it is true for; stamp_ns: the site's now, or
    the time that the map is as of.
    """

    x_m: Floats
    y_m: Floats
    cell_m: float
    layers: Mapping[str, Floats32]
    merged: int
    stamp_ns: int

    def __getitem__(self, layer: str) -> Floats32:
        return self.layers[layer]

    @property
    def bounds(self) -> Bounds:
        """Outer edges [m]."""
        half = self.cell_m / 2
        return Bounds(self.x_m[0] - half, self.y_m[0] - half, self.x_m[-1] + half, self.y_m[-1] + half)


@dataclass(frozen=True)
class Span:
    """Layer values of one cell from its samples with first_ns <= stamp <= last_ns alone; NaN is unknown."""

    first_ns: int
    last_ns: int
    values: Mapping[str, float]


@dataclass(frozen=True)
class HistoryAnswer:
    """The cell with centre (x_m, y_m) over time, oldest first; spans in which nobody was there are left out."""

    x_m: float
    y_m: float
    spans: tuple[Span, ...]
    merged: int
    stamp_ns: int


# --- the map ---------------------------------------------------------------------------------------------------------


def encode_point(answer: PointAnswer) -> bytes:
    """Answer of `point`."""
    place = {"x_m": answer.x_m, "y_m": answer.y_m}
    return pack({**place, "values": _plain(answer.values), "merged": answer.merged, "stamp_ns": answer.stamp_ns})


def decode_point(data: bytes) -> PointAnswer:
    """Undo `encode_point`."""
    table = unpack(data, MAX_REPLY_BYTES, MAX_ITEMS)
    x, y, values = take(table, "x_m", float), take(table, "y_m", float), _take_values(table)
    return PointAnswer(x, y, values, take(table, "merged", int), take(table, "stamp_ns", int))


def encode_region(region: Region) -> bytes:
    """Answer of `region`: layers as float32 little-endian, row by row from the south."""
    layers = {name: np.ascontiguousarray(values, "<f4").tobytes() for name, values in region.layers.items()}
    return pack(
        {
            "west_m": float(region.x_m[0] - region.cell_m / 2),
            "south_m": float(region.y_m[0] - region.cell_m / 2),
            "cell_m": region.cell_m,
            "columns": len(region.x_m),
            "rows": len(region.y_m),
            "layers": layers,
            "merged": region.merged,
            "stamp_ns": region.stamp_ns,
        }
    )


def decode_region(data: bytes) -> Region:
    """Undo `encode_region`."""
    table = unpack(data, MAX_REPLY_BYTES, MAX_ITEMS)
    cell_m, columns, rows = take(table, "cell_m", float), take(table, "columns", int), take(table, "rows", int)
    if not (0 < cell_m <= MAX_CELL_M and columns > 0 and rows > 0 and columns * rows <= MAX_CELLS):
        raise MessageError(Refusal.OUT_OF_RANGE, f"{columns} x {rows} cells of {cell_m} m", field="columns, rows")
    if not (tables := take(table, "layers", dict)):  # what is in them proves the number of cells
        raise MessageError(Refusal.MISSING_FIELD, "empty", field="layers")
    layers = {name: _decode_layer(tables, name, rows, columns) for name in tables}
    west_m, south_m = (_take_place(table, name) for name in ("west_m", "south_m"))
    return Region(
        x_m=west_m + (np.arange(columns) + 0.5) * cell_m,
        y_m=south_m + (np.arange(rows) + 0.5) * cell_m,
        cell_m=cell_m,
        layers=layers,
        merged=take(table, "merged", int),
        stamp_ns=take(table, "stamp_ns", int),
    )


def _take_place(table: dict[str, Any], name: str) -> float:
    value: float = take(table, name, float)
    if abs(value) > MAX_PLACE_M:
        raise MessageError(Refusal.OUT_OF_RANGE, f"{value} is beyond {MAX_PLACE_M:g} m", field=name)
    return value


def _decode_layer(layers: dict[str, Any], name: str, rows: int, columns: int) -> Floats32:
    data: bytes = take(layers, name, bytes)
    if type(name) is not str or len(data) != 4 * rows * columns:
        problem = f"{len(data)} bytes, {columns} x {rows} cells take {4 * rows * columns}"
        raise MessageError(Refusal.COLUMN_LENGTH, problem, field=f"layers.{name!s:.40}")
    return np.frombuffer(data, "<f4").reshape(rows, columns)


def encode_history(answer: HistoryAnswer) -> bytes:
    """Answer of `history`."""
    spans = [{"first_ns": s.first_ns, "last_ns": s.last_ns, "values": _plain(s.values)} for s in answer.spans]
    place = {"x_m": answer.x_m, "y_m": answer.y_m}
    return pack({**place, "spans": spans, "merged": answer.merged, "stamp_ns": answer.stamp_ns})


def decode_history(data: bytes) -> HistoryAnswer:
    """Undo `encode_history`."""
    table = unpack(data, MAX_REPLY_BYTES, MAX_ITEMS)
    spans = tuple(
        Span(take(span, "first_ns", int), take(span, "last_ns", int), _take_values(span))
        for span in _take_rows(table, "spans")
    )
    x, y = take(table, "x_m", float), take(table, "y_m", float)
    return HistoryAnswer(x, y, spans, take(table, "merged", int), take(table, "stamp_ns", int))


def _plain(values: Mapping[str, float]) -> dict[str, float]:
    return {name: float(value) for name, value in values.items()}


def _take_values(table: dict[str, Any]) -> dict[str, float]:
    values: dict[str, float] = take(table, "values", dict)
    for name, value in values.items():
        if type(name) is not str or type(value) is not float:  # NaN is unknown, so `take` would be too strict
            raise MessageError(Refusal.WRONG_TYPE, "a number is expected", field=f"values.{name!s:.40}")
    return values


# --- plain tables ----------------------------------------------------------------------------------------------------


def encode_info(info: Mapping[str, Any]) -> bytes:
    """Answer of `info`: nested tables of plain values."""
    return pack({"info": dict(info)})


def decode_info(data: bytes) -> dict[str, Any]:
    """Undo `encode_info`."""
    info: dict[str, Any] = take_plain(unpack(data, MAX_REPLY_BYTES, MAX_ITEMS), "info")
    return info


def encode_machines(machines: Sequence[Mapping[str, Any]]) -> bytes:
    """Answer of `machines`: a table of plain values for each."""
    return pack({"machines": [dict(machine) for machine in machines]})


def decode_machines(data: bytes) -> list[dict[str, Any]]:
    """Undo `encode_machines`."""
    return _take_rows(unpack(data, MAX_REPLY_BYTES, MAX_ITEMS), "machines")


def encode_machine(machine: Mapping[str, Any]) -> bytes:
    """Answer to a command about one machine: what `machines` says of it, and more."""
    return pack({"machine": dict(machine)})


def decode_machine(data: bytes) -> dict[str, Any]:
    """Undo `encode_machine`."""
    machine: dict[str, Any] = take_plain(unpack(data, MAX_REPLY_BYTES, MAX_ITEMS), "machine")
    return machine


def encode_changes(changes: Sequence[Mapping[str, Any]]) -> bytes:
    """Answer of `changes`: a table of plain values for each."""
    return pack({"changes": [dict(change) for change in changes]})


def decode_changes(data: bytes) -> list[dict[str, Any]]:
    """Undo `encode_changes`."""
    return _take_rows(unpack(data, MAX_REPLY_BYTES, MAX_ITEMS), "changes")


def encode_change(change: Mapping[str, Any]) -> bytes:
    """The event that an area changed, put on `map/changed`."""
    return pack({"change": dict(change)})


def decode_change(data: bytes) -> dict[str, Any]:
    """Undo `encode_change`."""
    change: dict[str, Any] = take_plain(unpack(data, MAX_SMALL_BYTES), "change")
    return change


def _take_rows(table: dict[str, Any], name: str) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = take(table, name, list)
    for index, row in enumerate(rows):
        if type(row) is not dict:
            raise MessageError(Refusal.WRONG_TYPE, f"map expected, not {type(row).__name__}", field=name, row=index)
        check_plain(row, f"{name}[{index}]")
    return rows


# --- refused ---------------------------------------------------------------------------------------------------------


def encode_error(error: QueryError) -> bytes:
    """Answer to a query or a command that is refused."""
    return pack({"reason": error.reason, "problem": str(error)})


def decode_error(data: bytes) -> QueryError:
    """Undo `encode_error`."""
    table = unpack(data, MAX_SMALL_BYTES)
    return QueryError(take(table, "reason", str), take(table, "problem", str))
