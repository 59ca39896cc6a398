"""Lanes, where machines drove by heading: the query `lanes`, its answer and bytes."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from protocol.arrays import Floats
from protocol.errors import Refusal
from protocol.machine.readings import MAX_STAMP_NS
from protocol.queries.answers import MapVersion
from protocol.queries.map_tiles import Scale
from protocol.queries.parameters import RECTANGLE, STAMP
from protocol.queries.request import Codec, MapQuery, Size, asked
from protocol.site.geometry import BLOCK_CELLS, Bounds
from protocol.wire.codec import MAX_SEQ
from protocol.wire.fields import check, inflated, pack, take, take_int, take_store, unpack

SECTORS = 16  # of heading, the first centred on east
SHAPE = (SECTORS, BLOCK_CELLS * BLOCK_CELLS)
SCALE_M = Scale("log", 0.1, 100.0)  # metres in 8 bits: a step is 2.8 %
SLOPE_CELLS = 4  # edge of the parts that slopes are of: places err by a metre or two, so shorter waves are lost anyway
SLOPES = (2, (BLOCK_CELLS // SLOPE_CELLS) ** 2)
SLOPE_STEP, UNKNOWN_SLOPE = 0.002, -128  # [m/m], up to 25 %: a step adds 0.06 % to a slope's error of 0.2 to 0.3 %
MOST_TILES = 16_384  # per answer: 4 km2 of driven 1 m cells
MAX_LANES_BYTES = 2**26
MOST = 2**31 - 1  # of positions and passes


@dataclass(frozen=True)
class LaneTile:
    """Lanes in a square of 16 x 16 cells.

    x, y: its column and row. newest_ns: newest stamp. passes: maximum of a cell; days, machines: number. metres: (16,
    256), by heading sector and cell, rows from the south, in steps of SCALE_M, 0 for none; old driving counts less.
    slopes: (2, 16), gradient east and north of 4 x 4 parts, rows from the south, in SLOPE_STEP, or UNKNOWN_SLOPE.
    """

    x: int
    y: int
    newest_ns: int
    passes: int
    days: int
    machines: int
    metres: NDArray[np.uint8]
    slopes: NDArray[np.int8]


@dataclass(frozen=True)
class LanesAnswer:
    """Squares with evidence since a stamp, or all. stamp_ns: the site's now."""

    version: MapVersion
    stamp_ns: int
    cell_m: float
    tiles: tuple[LaneTile, ...]


_WHOLE = (("x", -MOST, MOST), ("y", -MOST, MOST), ("newest_ns", 0, MAX_STAMP_NS))
_COUNTS = tuple((name, 0, MOST) for name in ("passes", "days", "machines"))
HEAD = (*_WHOLE, *_COUNTS)


def encode_lanes(answer: LanesAnswer) -> bytes:
    """Numbers of the squares as columns, all metres deflated together, and all slopes."""
    version, tiles = answer.version, answer.tiles
    columns = {name: np.array([getattr(tile, name) for tile in tiles], "<i8").tobytes() for name, _, _ in HEAD}
    deflating = zlib.compressobj()
    metres = b"".join([*(deflating.compress(tile.metres.tobytes()) for tile in tiles), deflating.flush()])
    table = {"store": version.store, "row": version.row, "fact": version.fact, "stamp_ns": answer.stamp_ns}
    head = {"cell_m": answer.cell_m, "n": len(tiles), "cols": columns}
    slopes = zlib.compress(b"".join(tile.slopes.tobytes() for tile in tiles), 9)
    return pack({**table, **head, "metres": metres, "slopes": slopes})


def decode_lanes(data: bytes) -> LanesAnswer:
    """Undo `encode_lanes`; MessageError."""
    table = unpack(data, MAX_LANES_BYTES)
    n, cell_m, cols = take_int(table, "n", 0, MOST_TILES), take(table, "cell_m", float), take(table, "cols", dict)
    check(0.01 <= cell_m <= 100, "cell_m", f"{cell_m} is not between 0.01 and 100")
    columns = [_column(cols, name, n, low, high) for name, low, high in HEAD]
    plain = inflated(take(table, "metres", bytes), n * SHAPE[0] * SHAPE[1], "metres")
    metres = np.frombuffer(plain, np.uint8).reshape(n, *SHAPE)
    slopes = np.full((n, *SLOPES), UNKNOWN_SLOPE, np.int8)
    if table.get("slopes") is not None:
        plain = inflated(take(table, "slopes", bytes), slopes.size, "slopes")
        slopes = np.frombuffer(plain, np.int8).reshape(slopes.shape)
    x, y, newest_ns, passes, days, machines = columns
    tiles = tuple(map(LaneTile, x, y, newest_ns, passes, days, machines, metres, slopes))
    version = MapVersion(take_store(table), take_int(table, "row", 0, MAX_SEQ), take_int(table, "fact", 0, MAX_SEQ))
    return LanesAnswer(version, take_int(table, "stamp_ns", 0, MAX_STAMP_NS), cell_m, tiles)


STROKES = ("x_m", "y_m", "heading_rad", "metres")


def strokes(answer: LanesAnswer) -> dict[str, Floats]:
    """Driven cells as columns: centre [m], main heading [rad], metres in it."""
    steps = np.array([tile.metres for tile in answer.tiles], np.uint8).reshape(-1, *SHAPE)
    most = steps.max(axis=1)
    tile, cell = np.nonzero(most)
    corner = np.array([(each.x, each.y) for each in answer.tiles], np.int64).reshape(-1, 2)[tile] * BLOCK_CELLS
    place_m = (corner + np.stack([cell % BLOCK_CELLS, cell // BLOCK_CELLS], axis=1) + 0.5) * answer.cell_m
    heading_rad = steps.argmax(axis=1)[tile, cell] * (2 * np.pi / SECTORS)
    return dict(zip(STROKES, (*place_m.T, heading_rad, SCALE_M.values()[most[tile, cell]]), strict=True))


def _column(cols: dict[str, object], name: str, n: int, low: int, high: int) -> list[int]:
    data: bytes = take(cols, name, bytes)
    check(len(data) == 8 * n, f"cols.{name}", f"{len(data)} bytes for {n} squares", Refusal.COLUMN_LENGTH)
    values = np.frombuffer(data, "<i8")
    check(bool(((values >= low) & (values <= high)).all()), f"cols.{name}", f"not between {low} and {high}")
    whole: list[int] = values.tolist()
    return whole


@dataclass(frozen=True)
class LanesQuery(MapQuery[LanesAnswer]):
    """Lanes of a rectangle or (None) the whole map; since_ns: only squares with later samples."""

    bounds: Bounds | None = asked(RECTANGLE, "bounds", "west,south,east,north [m]; default all of the map", None)
    since_ns: int | None = asked(STAMP, "since", "squares with samples after this time alone", None)

    name = "lanes"
    help = "where machines drove, by heading, for machines that find their lane by it"
    codec = Codec(encode_lanes, decode_lanes)
    size = Size.SEARCH

    @property
    def is_long(self) -> bool:
        """See `MapQuery`."""
        return True
