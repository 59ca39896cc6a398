"""Answers of map queries to MessagePack and back (docs/protocol.md, "Map queries").

Unknown fields are ignored; a missing one is a MessageError that names it.
"""

import functools
import types
import typing
from collections.abc import Mapping
from dataclasses import asdict, fields, is_dataclass
from typing import Any, TypeVar

import numpy as np

from protocol.arrays import Floats, Floats32
from protocol.errors import MessageError, QueryError, Refusal
from protocol.queries import answers
from protocol.site.geometry import MAX_CELLS
from protocol.site.site_config import LEAST_CELL_M
from protocol.wire.fields import MAX_SMALL_BYTES, check_plain, pack, take, take_store, unpack

MAX_REPLY_BYTES = 2**23  # a piece has 0.8 MB, 2000 spans 1 MB
MAX_CHANGES = 1000  # per answer
MAX_CELL_M = 1e4
MAX_PLACE_M = 1e7  # from the origin
T = TypeVar("T")
_hints = functools.cache(typing.get_type_hints)


# --- the map ---------------------------------------------------------------------------------------------------------


def encode_point(answer: answers.PointAnswer) -> bytes:
    """Answer `point`."""
    place = {"x_m": answer.x_m, "y_m": answer.y_m}
    return pack(
        {**place, "values": _plain(answer.values), **encode_version(answer.version), "stamp_ns": answer.stamp_ns}
    )


def decode_point(data: bytes) -> answers.PointAnswer:
    """Undo `encode_point`."""
    table = unpack(data, MAX_REPLY_BYTES)
    x, y, values = take(table, "x_m", float), take(table, "y_m", float), _take_values(table)
    return answers.PointAnswer(x, y, values, decode_version(table), take(table, "stamp_ns", int))


def encode_points(answer: answers.PointsAnswer) -> bytes:
    """Answer `points`: centres as float64, layers as float32, little-endian."""
    place = {name: np.ascontiguousarray(getattr(answer, name), "<f8").tobytes() for name in ("x_m", "y_m")}
    layers = {name: np.ascontiguousarray(values, "<f4").tobytes() for name, values in answer.layers.items()}
    return pack({**place, "layers": layers, **encode_version(answer.version), "stamp_ns": answer.stamp_ns})


def decode_points(data: bytes) -> answers.PointsAnswer:
    """Undo `encode_points`."""
    table = unpack(data, MAX_REPLY_BYTES)
    x_m, y_m = (take_column(table, name) for name in ("x_m", "y_m"))
    if len(x_m) != len(y_m):
        raise MessageError(Refusal.COLUMN_LENGTH, f"{len(x_m)} places, and {len(y_m)}", field="y_m")
    tables = take(table, "layers", dict)
    layers = {name: _decode_layer(tables, name, 1, len(x_m))[0] for name in tables}
    return answers.PointsAnswer(x_m, y_m, layers, decode_version(table), take(table, "stamp_ns", int))


def take_column(table: dict[str, Any], name: str) -> Floats:
    """Take a field as numbers (n,), float64 little-endian; at least one."""
    data: bytes = take(table, name, bytes)
    if not data or len(data) % 8:
        raise MessageError(Refusal.COLUMN_LENGTH, f"{len(data)} bytes are no numbers of 8", field=name)
    return np.frombuffer(data, "<f8")


def encode_region(region: answers.Region) -> bytes:
    """Answer of `region` and `piece`: float32 little-endian, rows from the south."""
    layers = {name: np.ascontiguousarray(values, "<f4").tobytes() for name, values in region.layers.items()}
    return pack(
        {
            "west_m": float(region.x_m[0] - region.cell_m / 2),
            "south_m": float(region.y_m[0] - region.cell_m / 2),
            "cell_m": region.cell_m,
            "columns": len(region.x_m),
            "rows": len(region.y_m),
            "layers": layers,
            **encode_version(region.version),
            "stamp_ns": region.stamp_ns,
            **({"piece": asdict(region.piece)} if region.piece else {}),
        }
    )


def decode_region(data: bytes) -> answers.Region:
    """Undo `encode_region`."""
    table = unpack(data, MAX_REPLY_BYTES)
    cell_m, columns, rows = take(table, "cell_m", float), take(table, "columns", int), take(table, "rows", int)
    if not (LEAST_CELL_M <= cell_m <= MAX_CELL_M and columns > 0 and rows > 0 and columns * rows <= MAX_CELLS):
        raise MessageError(Refusal.OUT_OF_RANGE, f"{columns} x {rows} cells of {cell_m} m", field="columns, rows")
    if not (tables := take(table, "layers", dict)):  # their size proves the number of cells
        raise MessageError(Refusal.MISSING_FIELD, "empty", field="layers")
    layers = {name: _decode_layer(tables, name, rows, columns) for name in tables}
    west_m, south_m = (_take_place(table, name) for name in ("west_m", "south_m"))
    return answers.Region(
        x_m=west_m + (np.arange(columns) + 0.5) * cell_m,
        y_m=south_m + (np.arange(rows) + 0.5) * cell_m,
        cell_m=cell_m,
        layers=layers,
        version=decode_version(table),
        stamp_ns=take(table, "stamp_ns", int),
        piece=_take_piece(table, columns, rows),
    )


def _take_piece(table: dict[str, Any], columns: int, rows: int) -> answers.Piece | None:
    if table.get("piece") is None:
        return None
    piece = take_record(answers.Piece, table, "piece")
    inside = 0 <= piece.column <= piece.columns - columns and 0 <= piece.row <= piece.rows - rows
    if not (inside and 0 <= piece.number < piece.count and piece.columns * piece.rows <= MAX_CELLS):
        raise MessageError(Refusal.OUT_OF_RANGE, f"{piece} of {columns} x {rows} cells", field="piece")
    return piece


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


def encode_history(answer: answers.HistoryAnswer) -> bytes:
    """Answer `history`."""
    spans = [{"first_ns": s.first_ns, "last_ns": s.last_ns, "values": _plain(s.values)} for s in answer.spans]
    place = {"x_m": answer.x_m, "y_m": answer.y_m}
    return pack({**place, "spans": spans, **encode_version(answer.version), "stamp_ns": answer.stamp_ns})


def decode_history(data: bytes) -> answers.HistoryAnswer:
    """Undo `encode_history`."""
    table = unpack(data, MAX_REPLY_BYTES)
    spans = tuple(
        answers.HistorySpan(take(span, "first_ns", int), take(span, "last_ns", int), _take_values(span))
        for span in _take_tables(table, "spans")
    )
    x, y = take(table, "x_m", float), take(table, "y_m", float)
    return answers.HistoryAnswer(x, y, spans, decode_version(table), take(table, "stamp_ns", int))


def encode_version(version: answers.MapVersion) -> dict[str, Any]:
    """Version fields of an answer."""
    return {"store": version.store, "merged": version.row, "fact": version.fact}


def decode_version(table: dict[str, Any]) -> answers.MapVersion:
    """Undo `encode_version`."""
    return answers.MapVersion(take_store(table), take(table, "merged", int), take(table, "fact", int))


def _plain(values: Mapping[str, float]) -> dict[str, float]:
    return {name: float(value) for name, value in values.items()}


def _take_values(table: dict[str, Any]) -> dict[str, float]:
    values: dict[str, float] = take(table, "values", dict)
    for name, value in values.items():
        if type(name) is not str or type(value) is not float:  # NaN is unknown; `take` would refuse it
            raise MessageError(Refusal.WRONG_TYPE, "a number is expected", field=f"values.{name!s:.40}")
    return values


def _take_tables(table: dict[str, Any], name: str) -> list[dict[str, Any]]:
    rows: list[Any] = take(table, name, list)
    for index, row in enumerate(rows):
        if type(row) is not dict:
            raise MessageError(Refusal.WRONG_TYPE, f"map expected, not {type(row).__name__}", field=name, row=index)
    return rows


# --- records ---------------------------------------------------------------------------------------------------------


def encode_alive(alive: answers.ServerAlive) -> bytes:
    """Answer `alive`."""
    return pack(asdict(alive))


def decode_alive(data: bytes) -> answers.ServerAlive:
    """Undo `encode_alive`."""
    table = unpack(data, MAX_SMALL_BYTES)
    journalled, merged = (take(table, name, int) for name in ("journalled", "merged"))
    return answers.ServerAlive(take_store(table), journalled, merged, take(table, "busy_s", float))


def encode_info(info: answers.MapInfo | Mapping[str, Any]) -> bytes:
    """Answer of `info`; here and below, of a record or a table."""
    return pack({"info": _table(info)})


def decode_info(data: bytes) -> answers.MapInfo:
    """Undo `encode_info`."""
    return take_record(answers.MapInfo, unpack(data, MAX_REPLY_BYTES), "info")


def encode_machines(answer: answers.MachinesAnswer) -> bytes:
    """Answer `machines`."""
    return pack({"machines": [_table(machine) for machine in answer.machines], **encode_version(answer.version)})


def decode_machines(data: bytes) -> answers.MachinesAnswer:
    """Undo `encode_machines`."""
    return answers.MachinesAnswer(*_take_records(answers.MachineState, data, "machines"))


def encode_machine(machine: answers.TrustAnswer | Mapping[str, Any]) -> bytes:
    """Answer to a command on a machine."""
    return pack({"machine": _table(machine)})


def decode_machine(data: bytes) -> answers.TrustAnswer:
    """Undo `encode_machine`."""
    return take_record(answers.TrustAnswer, unpack(data, MAX_REPLY_BYTES), "machine")


def encode_changes(answer: answers.ChangesAnswer) -> bytes:
    """Answer `changes`."""
    return pack({"changes": [_table(change) for change in answer.changes], **encode_version(answer.version)})


def decode_changes(data: bytes) -> answers.ChangesAnswer:
    """Undo `encode_changes`."""
    return answers.ChangesAnswer(*_take_records(answers.GroundChange, data, "changes"))


def encode_change(change: answers.GroundChange | Mapping[str, Any]) -> bytes:
    """Event of a changed area, on `map/changed`."""
    return pack({"change": _table(change)})


def decode_change(data: bytes) -> answers.GroundChange:
    """Undo `encode_change`."""
    return take_record(answers.GroundChange, unpack(data, MAX_SMALL_BYTES), "change")


def _table(record: Any) -> dict[str, Any]:
    return dict(record) if isinstance(record, Mapping) else asdict(record)


def take_record(cls: type[T], table: dict[str, Any], name: str) -> T:
    """Take a field as a record."""
    record: T = _value(cls, take(table, name, dict), name)
    return record


def _take_records(cls: type[T], data: bytes, name: str) -> tuple[tuple[T, ...], answers.MapVersion]:
    table = unpack(data, MAX_REPLY_BYTES)
    rows: list[Any] = take(table, name, list)
    return tuple(_value(cls, row, f"{name}[{index}]") for index, row in enumerate(rows)), decode_version(table)


def _value(hint: Any, value: Any, field: str) -> Any:
    """A plain value as its hint demands; field: its place."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is types.UnionType:
        return None if value is None else _value(arguments[0], value, field)
    if hint is Any:
        check_plain(value, field)
        return value
    if is_dataclass(hint):
        return _fields(hint, take({field: value}, field, dict), field)
    if origin is Mapping:
        return _mapping(arguments[1], take({field: value}, field, dict), field)
    if origin is tuple:
        return _tuple(arguments, take({field: value}, field, list), field)
    return take({field: value}, field, hint)


def _fields(cls: Any, table: dict[str, Any], field: str) -> Any:
    hints = _hints(cls)
    names = [item.name for item in fields(cls) if item.name in table or item.default is not None]
    if missing := [name for name in names if name not in table]:
        raise MessageError(Refusal.MISSING_FIELD, "missing", field=f"{field}.{missing[0]}")
    values = {name: _value(hints[name], table[name], f"{field}.{name}") for name in names}
    try:
        return cls(**values)
    except ValueError as error:
        raise MessageError(Refusal.OUT_OF_RANGE, str(error), field=field) from None


def _mapping(hint: Any, table: dict[str, Any], field: str) -> dict[str, Any]:
    for name in table:
        if type(name) is not str:
            raise MessageError(Refusal.WRONG_TYPE, f"the name {name!r:.40} is no text", field=field)
    return {name: _value(hint, value, f"{field}.{name:.40}") for name, value in table.items()}


def _tuple(hints: tuple[Any, ...], values: list[Any], field: str) -> tuple[Any, ...]:
    if hints[-1] is Ellipsis:
        hints = (hints[0],) * len(values)
    if len(values) != len(hints):
        raise MessageError(Refusal.WRONG_TYPE, f"{len(hints)} values expected, not {len(values)}", field=field)
    return tuple(_value(h, value, f"{field}[{i}]") for i, (h, value) in enumerate(zip(hints, values, strict=True)))


# --- refused ---------------------------------------------------------------------------------------------------------


def encode_error(error: QueryError) -> bytes:
    """Answer to a refused query or command."""
    again = {"retry_after_s": error.retry_after_s} if error.retry_after_s else {}
    return pack({"reason": error.reason, "problem": str(error), **again})


def decode_error(data: bytes) -> QueryError:
    """Undo `encode_error`."""
    table = unpack(data, MAX_SMALL_BYTES)
    return QueryError(take(table, "reason", str), take(table, "problem", str), take(table, "retry_after_s", float, 0.0))
