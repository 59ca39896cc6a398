"""Tiles of the present map, remade where evidence arrives, and of past maps.

A tile is a square of layers (block_layers.py), a function of evidence and repairs. Ages of cells count from its newest
sample, so time alone changes no tile.
"""

from __future__ import annotations

import threading
import zlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import product
from weakref import ReferenceType, ref

import numpy as np

from mapserver.change.detection import reach_blocks
from mapserver.change.validity import around
from mapserver.evidence.grid import Grid
from mapserver.evidence.timeline import Block
from mapserver.query.block_layers import SQUARE, BlockLayers, Kept, Look
from mapserver.query.region_pieces import PIECE_BYTES
from mapserver.query.source import MapSource, MapState
from mapserver.query.views import View
from protocol.arrays import Ints
from protocol.queries.answers import MapVersion
from protocol.queries.map_tiles import PLANES, TILE_CELLS, MapTile, Plane, TilesAnswer, TilesQuery
from protocol.site.geometry import BLOCK_CELLS, CellWindow

LAYERS = (*list(PLANES)[:-1], "newest_ns")  # `since` follows from it
AT_ONCE = 64  # tiles looked at together: 1024 blocks, 10 ms of the map's owner
TILE_HEAD_BYTES = 64  # upper bound, besides the planes
NOTHING = MapVersion("", 0, -1)
Place = tuple[int, int]  # column and row of a tile


@dataclass(frozen=True)
class Drawing:
    """An unfinished tile: planes (planes, 64, 64), and newest stamps (64, 64), 0 for none."""

    planes: Plane = field(default_factory=lambda: np.zeros((len(PLANES), TILE_CELLS, TILE_CELLS), np.uint8))
    newest_ns: Ints = field(default_factory=lambda: np.zeros((TILE_CELLS, TILE_CELLS), np.int64))

    def tile(self, place: Place, version: MapVersion) -> MapTile:
        """The finished tile."""
        newest = int(self.newest_ns.max())
        since_s = np.where(self.newest_ns > 0, (newest - self.newest_ns) / 1e9, np.nan)
        self.planes[-1] = PLANES["since"].quantised(since_s)
        return MapTile(*place, version.row, version.fact, newest, zlib.compress(self.planes.tobytes()))


@dataclass(frozen=True)
class _Drawn:
    """State of the tiles: turn of a grid and version drawn, and the origin of each block."""

    turn: int = -1
    grid: ReferenceType[Grid] | None = None  # a fact may bring another one
    version: MapVersion = NOTHING
    numbers: dict[Block, int] = field(default_factory=dict)
    drawings: dict[Place, Drawing] = field(default_factory=dict)


class Tiles:
    """Tiles of the present map; thread-safe. Costs depend on changes since the last query."""

    def __init__(self, source: MapSource, layers: BlockLayers) -> None:
        self._source, self._layers = source, layers
        self._cell_m = source.site.cell_m
        self._reach = reach_blocks(self._cell_m, source.config.change)
        self._lock = threading.Lock()
        self._tiles: dict[Place, MapTile] = {}
        self._drawn = _Drawn()

    def answer(self, query: TilesQuery) -> TilesAnswer:
        """Tiles that differ since the query's version; all for none of this store."""
        with self._lock:
            version, stamp_ns = self._update()
            since = query.since
            whole = (
                since is None or since.store != version.store or since.row > version.row or since.fact > version.fact
            )
            tiles = tuple(tile for tile in self._tiles.values() if whole or _is_newer(tile, since))
            return cut(TilesAnswer(version, stamp_ns, self._cell_m, whole, tiles), query.place)

    def _update(self) -> tuple[MapVersion, int]:
        """Redraw tiles with new evidence in or near them. The state is noted last, so a failure is retried."""
        places, drawn, stamp_ns = self._source.run(self._changed)
        if drawn.version.row < self._drawn.version.row:  # rows are gone: earlier versions cannot be compared
            self._tiles = {}
        whole = drawn.drawings is not self._drawn.drawings
        for some in _few(sorted({*places, *(self._tiles if whole else ())})):
            look = self._source.run(lambda state: self._look(state, some))  # noqa: B023 # called at once
            blocks = of_tiles(self._layers, look, some)
            others = {block: kept for block, kept in blocks.items() if drawn.numbers.get(block) != kept.number}
            gone = {place: drawn.drawings.setdefault(place, Drawing()) for place in (some if whole else ())}
            for place, drawing in (gone | draw(drawn.drawings, others)).items():
                known, made = self._tiles.get(place), drawing.tile(place, drawn.version)
                # new evidence makes a new tile, even with equal bytes: `Client.watch` reads finer values
                if not (whole and known and (known.newest_ns, known.planes) == (made.newest_ns, made.planes)):
                    self._tiles[place] = made
            drawn.numbers.update((block, kept.number) for block, kept in others.items())
        self._drawn = drawn
        return drawn.version, stamp_ns

    def _changed(self, state: MapState) -> tuple[set[Place], _Drawn, int]:
        """Tiles that may change, and the state to draw them from."""
        grid, last = state.grid, self._drawn
        whole = last.grid is None or last.grid() is not grid
        folded, turn = grid.folded_since(-1 if whole else last.turn)
        drawn = replace(last, turn=turn, grid=ref(grid), version=state.version)
        if whole:
            drawn = replace(drawn, numbers={}, drawings={})
        near = folded if whole else [one for block in folded for one in around(block, self._reach)]
        return {_tile_of(block) for block in near}, drawn, state.newest_ns

    def _look(self, state: MapState, places: Iterable[Place]) -> Look:
        return self._layers.look_blocks(state, {block for place in places for block in _blocks(place)}, LAYERS)


def _few(places: list[Place]) -> Iterator[list[Place]]:
    for first in range(0, len(places), AT_ONCE):
        yield places[first : first + AT_ONCE]


def _tile_of(block: Block) -> Place:
    return block[0] // SQUARE, block[1] // SQUARE


def _blocks(place: Place) -> list[Block]:
    """Blocks of a tile."""
    return [(SQUARE * place[0] + x, SQUARE * place[1] + y) for x, y in product(range(SQUARE), repeat=2)]


def of_tiles(layers: BlockLayers, look: Look, places: Iterable[Place]) -> dict[Block, Kept]:
    """Blocks of tiles with evidence."""
    return layers.blocks(look, [block for place in places for block in _blocks(place)], LAYERS)


def draw(drawings: dict[Place, Drawing], blocks: Mapping[Block, Kept]) -> dict[Place, Drawing]:
    """Draw blocks; returns the drawings touched."""
    drawn: dict[Place, Drawing] = {}
    if not blocks:
        return drawn
    n, kept = BLOCK_CELLS, blocks.values()
    layers = (np.stack([block.layers[name] for block in kept]).astype(np.float64) for name in LAYERS[:-1])
    planes = np.stack([PLANES[name].quantised(layer) for name, layer in zip(LAYERS, layers, strict=False)])
    for i, (block, own) in enumerate(blocks.items()):
        place = _tile_of(block)
        drawing = drawn[place] = drawings.setdefault(place, Drawing())
        column, row = (n * (at % SQUARE) for at in block)
        inside = slice(row, row + n), slice(column, column + n)
        drawing.planes[:-1, *inside] = planes[:, i].reshape(-1, n, n)
        drawing.newest_ns[inside] = own.layers["newest_ns"].reshape(n, n)
    return drawn


def _is_newer(tile: MapTile, since: MapVersion | None) -> bool:
    return since is None or tile.row > since.row or tile.fact > since.fact


def cut(answer: TilesAnswer, place: Place | None) -> TilesAnswer:
    """As much of an answer as one reply holds, from a place on."""
    tiles = sorted((tile for tile in answer.tiles if place is None or (tile.x, tile.y) >= place), key=_place)
    ends = np.cumsum([len(tile.planes) + TILE_HEAD_BYTES for tile in tiles])
    fit = max(1, int(np.searchsorted(ends, PIECE_BYTES, side="right")))
    next_place = _place(tiles[fit]) if fit < len(tiles) else None
    return replace(answer, tiles=tuple(tiles[:fit]), next_place=next_place)


def _place(tile: MapTile) -> Place:
    return tile.x, tile.y


def tiles_of(view: View, window: CellWindow, layers: BlockLayers) -> Iterator[MapTile]:
    """Tiles of a view in a window, whose edges are tiles' where the view goes on."""
    look, n = layers.look_at(view), BLOCK_CELLS
    inside = CellWindow(window.column // n, window.row // n, -(-window.columns // n), -(-window.rows // n))
    places = {_tile_of(block) for block in look.cell_turns if _is_in(block, inside)}
    for some in _few(sorted(places)):
        for place, drawing in sorted(draw({}, of_tiles(layers, look, some)).items()):
            yield drawing.tile(place, view.version)


def _is_in(block: Block, blocks: CellWindow) -> bool:
    return 0 <= block[0] - blocks.column < blocks.columns and 0 <= block[1] - blocks.row < blocks.rows
