"""Map queries and their answers: selector parameters one way, MessagePack the other (docs/protocol.md, "Map queries").

A query is parsed once, at the server's door, into a frozen type; an unknown parameter is refused by name.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from protocol.arrays import Floats, Floats32
from protocol.codec import pack, take, unpack
from protocol.errors import MessageError, QueryError, Refusal
from protocol.geometry import MAX_CELLS, Bounds

MAX_REPLY_BYTES = 2**30
MAX_WAIT_S = 60.0
MAX_CELL_M = 1e4


@dataclass(frozen=True)
class Freshness:
    """after: answer only once this journal row is merged; wait_s: how long to wait for it."""

    after: int = 0
    wait_s: float = 10.0


@dataclass(frozen=True)
class PointQuery:
    """The cell at a position in `map` [m]; no layers means all of them."""

    x_m: float
    y_m: float
    layers: tuple[str, ...] = ()
    fresh: Freshness = Freshness()

    name = "point"


@dataclass(frozen=True)
class RegionQuery:
    """All cells that a rectangle touches; no layers means all of them."""

    bounds: Bounds
    layers: tuple[str, ...] = ()
    fresh: Freshness = Freshness()

    name = "region"


@dataclass(frozen=True)
class InfoQuery:
    """The state of the map and of its server."""

    fresh: Freshness = Freshness()

    name = "info"


MapQuery = PointQuery | RegionQuery | InfoQuery


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
    NaN where unknown; row 0 is the southernmost. merged: the journal row it is true for; stamp_ns: the site's now.
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


# --- the query, as selector parameters -------------------------------------------------------------------------------


def encode_query(query: MapQuery) -> dict[str, str]:
    """Selector parameters."""
    parameters: dict[str, str] = {}
    if isinstance(query, PointQuery):
        parameters |= {"x": _text(query.x_m), "y": _text(query.y_m)}
    if isinstance(query, RegionQuery):
        b = query.bounds
        parameters["bounds"] = ",".join(_text(v) for v in (b.west_m, b.south_m, b.east_m, b.north_m))
    if not isinstance(query, InfoQuery) and query.layers:
        parameters["layers"] = ",".join(query.layers)
    if query.fresh.after:
        parameters |= {"after": str(query.fresh.after), "wait": _text(query.fresh.wait_s)}
    return parameters


def _text(number: float) -> str:
    """All digits; as a plain number, where numpy's own `repr` writes its type."""
    return repr(float(number))


def parse_query(name: str, parameters: Mapping[str, str]) -> MapQuery:
    """Parse the parameters of the query `name`; QueryError says what is wrong with which of them."""
    known = {"point": ("x", "y", "layers"), "region": ("bounds", "layers"), "info": ()}.get(name)
    if known is None:
        raise QueryError(Refusal.UNKNOWN_QUERY, f"query `{name}` is not known; known: point, region, info")
    known += ("after", "wait")
    if unknown := sorted(set(parameters) - set(known)):
        problem = f"parameter `{unknown[0][:40]}` is not known; `{name}` takes {', '.join(known)}"
        raise QueryError(Refusal.UNKNOWN_PARAMETER, problem)
    fresh = _parse_freshness(parameters)
    layers = tuple(part for part in parameters.get("layers", "").split(",") if part)
    if name == "point":
        x, y = (_number(parameters, axis) for axis in ("x", "y"))
        return PointQuery(x, y, layers, fresh)
    if name == "region":
        return RegionQuery(_parse_bounds(parameters), layers, fresh)
    return InfoQuery(fresh)


def check_size(columns: int, rows: int) -> None:
    """Refuse a region that no reply could carry."""
    if columns * rows > MAX_CELLS:
        raise QueryError(Refusal.TOO_LARGE, f"region of {columns} x {rows} cells; at most {MAX_CELLS} are answered")


def _parse_freshness(parameters: Mapping[str, str]) -> Freshness:
    after = _number({"after": "0", **parameters}, "after")
    wait_s = _number({"wait": "10", **parameters}, "wait")
    if after < 0 or after != int(after) or not 0 <= wait_s <= MAX_WAIT_S:
        problem = f"`after` must be a journal row and `wait` between 0 and {MAX_WAIT_S:g} s"
        raise QueryError(Refusal.OUT_OF_RANGE, problem)
    return Freshness(int(after), wait_s)


def _parse_bounds(parameters: Mapping[str, str]) -> Bounds:
    parts = parameters.get("bounds", "").split(",")
    if len(parts) != 4:
        raise QueryError(Refusal.MISSING_FIELD, "parameter `bounds` must be west,south,east,north in metres")
    numbers = [_number({"bounds": part}, "bounds") for part in parts]
    try:
        return Bounds(*numbers)
    except ValueError as error:
        raise QueryError(Refusal.OUT_OF_RANGE, str(error)) from None


def _number(parameters: Mapping[str, str], name: str) -> float:
    if name not in parameters:
        raise QueryError(Refusal.MISSING_FIELD, f"parameter `{name}` is missing")
    try:
        value = float(parameters[name])
    except ValueError:
        raise QueryError(Refusal.WRONG_TYPE, f"parameter `{name}`: {parameters[name][:40]!r} is no number") from None
    if not math.isfinite(value) or abs(value) > 1e15:
        raise QueryError(Refusal.NOT_FINITE, f"parameter `{name}`: {value} is not usable")
    return value


# --- answers ---------------------------------------------------------------------------------------------------------


def encode_point(answer: PointAnswer) -> bytes:
    """Answer of `point`."""
    values = {name: float(value) for name, value in answer.values.items()}
    place = {"x_m": answer.x_m, "y_m": answer.y_m}
    return pack({**place, "values": values, "merged": answer.merged, "stamp_ns": answer.stamp_ns})


def decode_point(data: bytes) -> PointAnswer:
    """Undo `encode_point`."""
    table = unpack(data, MAX_REPLY_BYTES)
    x, y, values = take(table, "x_m", float), take(table, "y_m", float), take(table, "values", dict)
    for name, value in values.items():
        if type(name) is not str or type(value) is not float:  # NaN is unknown, so `take` would be too strict
            raise MessageError(Refusal.WRONG_TYPE, "a number is expected", field=f"values.{name!s:.40}")
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
    table = unpack(data, MAX_REPLY_BYTES)
    cell_m, columns, rows = take(table, "cell_m", float), take(table, "columns", int), take(table, "rows", int)
    if not (0 < cell_m <= MAX_CELL_M and columns > 0 and rows > 0 and columns * rows <= MAX_CELLS):
        raise MessageError(Refusal.OUT_OF_RANGE, f"{columns} x {rows} cells of {cell_m} m", field="columns, rows")
    tables = take(table, "layers", dict)
    layers = {name: _decode_layer(tables, name, rows, columns) for name in tables}
    return Region(
        x_m=take(table, "west_m", float) + (np.arange(columns) + 0.5) * cell_m,
        y_m=take(table, "south_m", float) + (np.arange(rows) + 0.5) * cell_m,
        cell_m=cell_m,
        layers=layers,
        merged=take(table, "merged", int),
        stamp_ns=take(table, "stamp_ns", int),
    )


def _decode_layer(layers: dict[str, Any], name: str, rows: int, columns: int) -> Floats32:
    data: bytes = take(layers, name, bytes)
    if type(name) is not str or len(data) != 4 * rows * columns:
        problem = f"{len(data)} bytes, {columns} x {rows} cells take {4 * rows * columns}"
        raise MessageError(Refusal.COLUMN_LENGTH, problem, field=f"layers.{name!s:.40}")
    return np.frombuffer(data, "<f4").reshape(rows, columns)


def encode_info(info: Mapping[str, Any]) -> bytes:
    """Answer of `info`: nested tables of plain values."""
    return pack({"info": dict(info)})


def decode_info(data: bytes) -> dict[str, Any]:
    """Undo `encode_info`."""
    info: dict[str, Any] = take(unpack(data, MAX_REPLY_BYTES), "info", dict)
    return info


def encode_error(error: QueryError) -> bytes:
    """Answer to a query that is refused."""
    return pack({"reason": error.reason, "problem": str(error)})


def decode_error(data: bytes) -> QueryError:
    """Undo `encode_error`."""
    table = unpack(data, MAX_REPLY_BYTES)
    return QueryError(take(table, "reason", str), take(table, "problem", str))
