"""Tiles: squares of 64 x 64 cells with a few 8-bit layers, for drawing."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from protocol.arrays import Floats
from protocol.errors import MessageError, QueryError, Refusal
from protocol.queries.answers import MapVersion
from protocol.queries.parameters import METRES, ValueForm, ValueKind, count, name_of
from protocol.queries.request import AsOf, Codec, Group, Parameter, Size, asked, grouped
from protocol.wire.codec import MAX_SEQ
from protocol.wire.fields import inflated, pack, take, unpack

TILE_CELLS = 64
AREA = TILE_CELLS * TILE_CELLS
Plane = NDArray[np.uint8]


@dataclass(frozen=True)
class Scale:
    """Meaning of 8 bits: 0 unknown, 1 to 255 a value.

    kind: "log", "linear": even steps from low to high; "count": the value; "since": seconds before the tile's newest
    sample, low (2^((q - 1) / steps) - 1).
    """

    kind: Literal["log", "linear", "count", "since"]
    low: float = 0.0
    high: float = 0.0
    steps: float = 0.0

    def quantised(self, values: Floats) -> Plane:
        """8 bits (...) of values (...): nearest step, clipped; 0 for NaN."""
        with np.errstate(divide="ignore", invalid="ignore"):
            match self.kind:
                case "log":
                    step = 1 + 254 * np.log(values / self.low) / np.log(self.high / self.low)
                case "linear":
                    step = 1 + 254 * (values - self.low) / (self.high - self.low)
                case "count":
                    step = values
                case "since":
                    step = 1 + self.steps * np.log2(1 + values / self.low)
        known = ~np.isnan(step)
        out: Plane = np.where(known, np.clip(np.rint(np.where(known, step, 0)), 1, 255), 0).astype(np.uint8)
        return out

    def values(self) -> Floats:
        """Values (256,) of all steps; NaN for 0."""
        step = np.arange(256, dtype=np.float64)
        part = (step - 1) / 254
        match self.kind:
            case "log":
                out = self.low * (self.high / self.low) ** part
            case "linear":
                out = self.low + (self.high - self.low) * part
            case "count":
                out = step
            case "since":
                out = self.low * (2 ** ((step - 1) / self.steps) - 1)
        out[0] = np.nan
        return out


# Steps: c_rr 1.8 %, slope 0.3 % grade, time 4 % up to a week. Driven cells without measurement have visits only.
PLANES: dict[str, Scale] = {
    "resistance": Scale("log", 0.004, 0.4),
    "confidence": Scale("linear", 0.0, 1.0),
    "grade": Scale("linear", 0.0, 0.75),
    "grade_std": Scale("linear", 0.0, 0.25),
    "visits": Scale("count"),
    "since": Scale("since", low=10.0, steps=16.0),
}


@dataclass(frozen=True)
class MapTile:
    """A square; x, y: tile column and row from the origin.

    row, fact: map version of its last change. newest_ns: newest stamp. planes: those of PLANES in order, rows from the
    south, deflated (zlib).
    """

    x: int
    y: int
    row: int
    fact: int
    newest_ns: int
    planes: bytes

    def unpacked(self) -> dict[str, Plane]:
        """Planes (64, 64) by name."""
        data = np.frombuffer(zlib.decompress(self.planes), np.uint8).reshape(len(PLANES), TILE_CELLS, TILE_CELLS)
        return dict(zip(PLANES, data, strict=True))


@dataclass(frozen=True)
class TilesAnswer:
    """Tiles of a map version. whole: all; else those changed since a version.

    next_place: tile column and row at which the rest begins, or None.
    """

    version: MapVersion
    stamp_ns: int
    cell_m: float
    whole: bool
    tiles: tuple[MapTile, ...]
    next_place: tuple[int, int] | None = None


def encode_tiles(answer: TilesAnswer) -> bytes:
    """Answer of `tiles`."""
    version = {"store": answer.version.store, "merged": answer.version.row, "fact": answer.version.fact}
    rows = [[tile.x, tile.y, tile.row, tile.fact, tile.newest_ns, tile.planes] for tile in answer.tiles]
    state = {"stamp_ns": answer.stamp_ns, "cell_m": answer.cell_m, "whole": answer.whole}
    rest = {"next": list(answer.next_place)} if answer.next_place else {}
    return pack({**version, **state, "planes": list(PLANES), "tiles": rows, **rest})


def decode_tiles(data: bytes) -> TilesAnswer:
    """Undo `encode_tiles`; planes other than PLANES are refused."""
    table = unpack(data, 2**28)
    if (names := take(table, "planes", list)) != list(PLANES):
        raise MessageError(Refusal.OUT_OF_RANGE, f"{names!s:.80} are not {', '.join(PLANES)}", field="planes")
    tiles = tuple(_tile(row, index) for index, row in enumerate(take(table, "tiles", list)))
    version = MapVersion(take(table, "store", str), take(table, "merged", int), take(table, "fact", int))
    stamp_ns, cell_m = take(table, "stamp_ns", int), take(table, "cell_m", float)
    rest: list[Any] = take(table, "next", list, [])
    if [type(number) for number in rest] not in ([], [int, int]) or any(abs(number) > MAX_SEQ for number in rest):
        raise MessageError(Refusal.WRONG_TYPE, "two whole numbers are expected", field="next")
    next_place = (rest[0], rest[1]) if rest else None
    return TilesAnswer(version, stamp_ns, cell_m, take(table, "whole", bool), tiles, next_place)


def _tile(row: Any, index: int) -> MapTile:
    if type(row) is not list or [type(value) for value in row] != [int] * 5 + [bytes]:
        raise MessageError(Refusal.WRONG_TYPE, "five whole numbers and bytes are expected", field="tiles", row=index)
    x, y, version_row, fact, newest_ns, planes = row
    if any(abs(number) > MAX_SEQ for number in row[:-1]):
        raise MessageError(Refusal.OUT_OF_RANGE, f"{row[:-1]}", field="tiles", row=index)
    inflated(planes, len(PLANES) * AREA, "tiles", index)
    return MapTile(x, y, version_row, fact, newest_ns, planes)


_SINCE = (
    Parameter("store", "of the version that the asker has", name_of()),
    Parameter("row", "its row", count(is_stated=True)),
    Parameter("fact", "its fact", count(is_stated=True)),
)


def _write_since(since: MapVersion | None) -> dict[str, str]:
    return {"store": since.store, "row": str(since.row), "fact": str(since.fact)} if since else {}


def _read_tile(name: str, text: str) -> tuple[int, int]:
    numbers = [METRES.read(name, part) for part in text.split(",")]
    if len(numbers) != 2 or any(n != int(n) for n in numbers):
        raise QueryError(Refusal.OUT_OF_RANGE, f"parameter `{name}` must be column,row of a tile")
    return int(numbers[0]), int(numbers[1])


TILE = ValueKind(ValueForm.TEXT, _read_tile, lambda value: f"{value[0]},{value[1]}")


@dataclass(frozen=True)
class TilesQuery(AsOf[TilesAnswer]):
    """Tiles of the map: all, those changed since a version, or all as of a time [ns].

    place: column and row of the first tile to answer; None from the beginning.
    """

    since: MapVersion | None = grouped(
        Group(_SINCE, lambda given: MapVersion(*(one.read(given) for one in _SINCE)), _write_since), None
    )
    place: tuple[int, int] | None = asked(TILE, "place", "column,row of the tile to begin at", None)

    name = "tiles"
    help = "the map in tiles of 8-bit layers"
    codec = Codec(encode_tiles, decode_tiles)
    size = Size.PIECE

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.since and self.as_of_ns is not None:
            problem = "`as_of` with a version: the tiles of a time do not change, ask for all"
            raise QueryError(Refusal.OUT_OF_RANGE, problem)
