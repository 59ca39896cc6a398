"""Regions in pieces: cutting, and views kept while a reader takes them.

An answer is small enough for the router to hold it for a slow reader (protocol/wire/session.py), so nobody else waits.
All pieces are of one map version, so its pages are kept, at little cost: they are immutable, and shared with the grid.
Those of the past are not: each piece folds its own.
"""

from __future__ import annotations

import math
import secrets
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

from mapserver.query.block_layers import Look
from protocol.errors import QueryError, Refusal
from protocol.queries.answers import Piece
from protocol.queries.places import Place
from protocol.site.geometry import BLOCK_CELLS, CellWindow

PIECE_BYTES = 256 * 256 * 3 * 4  # largest answer: three layers of 256 x 256 cells
LookAt = Callable[[CellWindow], Look]  # sources of a piece, in map cells
MEAN_CELLS = 2**19  # map cells averaged at once, or a larger cell: means take 20 bytes each
READ_BYTES = 2**24  # most cell layers read per answer, if larger cells are their means
MOST_OPEN = 16  # regions read at the same time
IDLE_S = 30.0  # time without a request that drops a region; a piece takes 20 s at 300 kbit/s
OPEN_S = 600.0  # time that drops an open region, as its pages leave the grid


@dataclass(frozen=True)
class RegionReading:
    """Sources of a region: layers, and a map, or the difference of two.

    window: in the answer's cells, `count` map cells to a side. outline: unknown outside. is_past: pieces are folded
    from the journal.
    """

    window: CellWindow
    layers: tuple[str, ...]
    sources: tuple[LookAt, ...]
    count: int = 1
    outline: tuple[Place, ...] = ()
    is_past: bool = False


@dataclass(frozen=True)
class PieceGrid:
    """Pieces of a window, by rows from the south-west; edges between blocks where possible.

    width, height: of a piece [cells]; step: grid of edges [cells].
    """

    window: CellWindow
    width: int
    height: int
    step: int = BLOCK_CELLS

    @classmethod
    def of_layers(cls, window: CellWindow, layers: int, count: int = 1) -> PieceGrid:
        """Square pieces of at most PIECE_BYTES, read from READ_BYTES; longer in narrow windows.

        count: map cells to a side of the window's. QueryError if one exceeds READ_BYTES.
        """
        cells = min(PIECE_BYTES // (4 * layers), READ_BYTES // (4 * layers * count**2))
        step = 1 if count > 1 else BLOCK_CELLS
        if not cells:
            most = math.isqrt(READ_BYTES // (4 * layers))
            problem = f"cells of {count} x {count} cells of the map, with {layers} layers"
            instead = "ask for fewer `layers`, or a finer `resolution`"
            raise QueryError(Refusal.TOO_LARGE, f"{problem}: at most {most} x {most}; {instead}")
        if window.columns * window.rows <= cells:
            return cls(window, window.columns + step, window.rows + step, step)
        side = math.isqrt(cells)
        if window.rows < side:
            return cls(window, _whole(cells // window.rows, step), window.rows + step, step)
        if window.columns < side:
            return cls(window, window.columns + step, _whole(cells // window.columns, step), step)
        return cls(window, _whole(side, step), _whole(side, step), step)

    @classmethod
    def of_means(cls, window: CellWindow, count: int) -> PieceGrid:
        """Parts of a window whose cells are averaged at once."""
        side = max(1, math.isqrt(MEAN_CELLS) // count)
        return cls(window, side, side, step=1)

    @property
    def count(self) -> int:
        """Number of pieces."""
        return len(self._columns) * len(self._rows)

    def piece(self, number: int) -> CellWindow:
        """A piece by its number."""
        left, right = self._columns[number % len(self._columns)]
        bottom, top = self._rows[number // len(self._columns)]
        return CellWindow(left, bottom, right - left, top - bottom)

    def place(self, number: int, cursor: int) -> Piece:
        """Position of a piece."""
        piece, whole = self.piece(number), self.window
        corner = (piece.column - whole.column, piece.row - whole.row)
        return Piece(cursor, number, self.count, *corner, whole.columns, whole.rows)

    @cached_property
    def _columns(self) -> list[tuple[int, int]]:
        return _cut(self.window.column, self.window.columns, self.width, self.step)

    @cached_property
    def _rows(self) -> list[tuple[int, int]]:
        return _cut(self.window.row, self.window.rows, self.height, self.step)


def _whole(cells: int, step: int) -> int:
    return max(step, cells // step * step)


def _cut(first: int, count: int, length: int, step: int) -> list[tuple[int, int]]:
    """Begin and end of pieces along an axis."""
    edges = [first, *range(first // step * step + length, first + count, length), first + count]
    return list(pairwise(edges))


@dataclass
class _Open:
    reading: RegionReading
    opened_s: float
    used_s: float
    is_read: bool = False  # to its last piece


class OpenRegions:
    """Regions being read, by cursor."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._open: dict[int, _Open] = {}

    def make_room(self) -> None:
        """Drop finished and abandoned regions; QueryError if too many are being read."""
        with self._lock:
            self._forget()
            while len(self._open) >= MOST_OPEN:
                read = next((cursor for cursor, one in self._open.items() if one.is_read), None)
                if read is None:
                    problem = f"{len(self._open)} large regions are being read; ask again later, or for a smaller one"
                    raise QueryError(Refusal.OVERLOADED, problem, retry_after_s=2.0)
                del self._open[read]

    def open(self, reading: RegionReading) -> int:
        """Keep a region's sources; returns its cursor. QueryError as `make_room`."""
        self.make_room()
        cursor, now_s = 1 + secrets.randbelow(2**48), time.monotonic()
        with self._lock:
            self._open[cursor] = _Open(reading, now_s, now_s)
        return cursor

    def reading(self, cursor: int, number: int) -> tuple[RegionReading, PieceGrid]:
        """Sources of a piece; QueryError if expired or out of range."""
        with self._lock:
            self._forget()
            one = self._open.get(cursor)
            if one is None:
                raise QueryError(Refusal.EXPIRED, f"no region is open under cursor {cursor}: ask for it again")
            pieces = PieceGrid.of_layers(one.reading.window, len(one.reading.layers), one.reading.count)
            if number >= pieces.count:
                raise QueryError(Refusal.OUT_OF_RANGE, f"parameter `number`: {number} of {pieces.count} pieces, from 0")
            one.used_s, one.is_read = time.monotonic(), one.is_read or number == pieces.count - 1
            return one.reading, pieces

    def is_past(self, cursor: int) -> bool:
        """Whether an open region is of the past, whose next piece may wait for its turn."""
        with self._lock:
            one = self._open.get(cursor)
            if one is None or not one.reading.is_past:
                return False
            one.used_s = time.monotonic()
            return True

    def _forget(self) -> None:
        now_s = time.monotonic()
        for cursor, one in list(self._open.items()):
            if now_s > min(one.used_s + IDLE_S, one.opened_s + OPEN_S):
                del self._open[cursor]
