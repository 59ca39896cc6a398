"""Tiles of the present map, remade where evidence arrives, and of past maps.

A tile is a square of layers (block_layers.py), a function of evidence and road ages. Ages of cells count from its
newest sample, so time alone changes no tile. Road ages are seconds old, because pages ask ten times a second, and enter
with new rows.
"""

from __future__ import annotations

import threading
import zlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from weakref import ReferenceType, ref

import numpy as np

from mapserver.change.detection import reach_blocks
from mapserver.change.validity import Ages, around
from mapserver.evidence.grid import Grid
from mapserver.evidence.timeline import Block
from mapserver.query.block_layers import NEVER, SQUARE, BlockLayers, Kept, Look
from mapserver.query.region_pieces import PIECE_BYTES
from mapserver.query.source import MapSource, MapState
from mapserver.query.views import StillMap, View
from protocol.queries.answers import MapVersion
from protocol.queries.map_tiles import PLANES, MapTile, TilesAnswer, TilesQuery
from protocol.site.geometry import BLOCK_CELLS

LAYERS = (*list(PLANES)[:-1], "newest_ns")  # which `since` follows from
AT_ONCE = 64  # tiles that are looked at together: 1024 blocks, which take whoever owns the map some 10 ms
TILE_HEAD_BYTES = 64  # of a tile beside its planes, at most
Place = tuple[int, int]  # column and row of a tile
Blocks = list[Kept | None]  # of a tile, row by row; None without evidence
Numbers = tuple[int, ...]  # theirs
NOTHING: Numbers = (NEVER,) * SQUARE**2


class Tiles:
    """Tiles of the present map; thread-safe. Costs depend on changes since the last query."""

    def __init__(self, source: MapSource, layers: BlockLayers, ages: Callable[[], Ages]) -> None:
        """ages: recent ages of road cells."""
        self._source, self._layers, self._lately = source, layers, ages
        self._cell_m = source.site.cell_m
        self._reach = reach_blocks(self._cell_m, source.config.change)
        self._lock = threading.Lock()
        self._tiles: dict[Place, tuple[Numbers, MapTile]] = {}
        self._turn, self._fact, self._row = -1, -1, 0
        self._ages: Ages = {}
        self._marks: dict[object, bytes] = {}
        self._grid: ReferenceType[Grid] | None = None  # the last one; a fact may bring another one

    def answer(self, query: TilesQuery) -> TilesAnswer:
        """Tiles that differ since the version that the query names; all where it names none of this store."""
        with self._lock:
            version, stamp_ns = self._update()
            since = query.since
            whole = (
                since is None or since.store != version.store or since.row > version.row or since.fact > version.fact
            )
            tiles = tuple(tile for _, tile in self._tiles.values() if whole or _is_newer(tile, since))
            return cut(TilesAnswer(version, stamp_ns, self._cell_m, whole, tiles), query.place)

    def _update(self) -> tuple[MapVersion, int]:
        """Make anew what evidence came into, and what lies so near that a change of the ground there counts for it."""
        ages = self._lately()
        places, whole, version, stamp_ns = self._source.run(lambda state: self._changed(state, ages))
        if version.row < self._row:  # rows are gone: what was said of them differs from no version
            self._tiles = {}
        for some in _few(sorted({*places, *(self._tiles if whole else ())})):
            look = self._source.run(lambda state: self._look(state, some))  # noqa: B023 # called at once
            for place, blocks in of_tiles(self._layers, look, some):
                numbers = tuple(block.number if block else NEVER for block in blocks)
                known, tile = self._tiles.get(place, (NOTHING, None))
                if numbers == known:
                    continue
                made = tile_of(place, blocks, version)
                # what evidence came into is another one, though its bytes are not: `Client.watch` reads finer values
                is_same = whole and tile and (tile.newest_ns, tile.planes) == (made.newest_ns, made.planes)
                self._tiles[place] = numbers, tile if tile and is_same else made
        self._fact, self._row = version.fact, version.row
        return version, stamp_ns

    def _changed(self, state: MapState, ages: Ages) -> tuple[set[Place], bool, MapVersion, int]:
        """Tiles that may be others, and whether those are all."""
        grid, known_grid = state.grid, self._grid and self._grid()
        whole = state.version.fact != self._fact or grid is not known_grid
        aged: list[Block] = []
        if whole or state.version.row != self._row:
            aged = [block for block in ages.keys() | self._ages.keys() if not _is_same(ages, self._ages, block)]
            if ages is not self._ages:
                self._ages, self._marks = ages, {}
        folded, self._turn = grid.folded_since(-1 if whole else self._turn)
        self._grid = ref(grid)
        near = folded if whole else [*aged, *(one for block in folded for one in around(block, self._reach))]
        return {_tile_of(block) for block in near}, whole, state.version, state.newest_ns

    def _look(self, state: MapState, places: Iterable[Place]) -> Look:
        aged = StillMap(state.grid, state.version, state.newest_ns, self._ages, self._marks)
        return self._layers.look_blocks(aged, {block for place in places for block in _blocks(place)}, LAYERS)


def _few(places: list[Place]) -> Iterator[list[Place]]:
    for first in range(0, len(places), AT_ONCE):
        yield places[first : first + AT_ONCE]


def _tile_of(block: Block) -> Place:
    return block[0] // SQUARE, block[1] // SQUARE


def _blocks(place: Place) -> list[Block]:
    """Blocks of a tile."""
    return [(SQUARE * place[0] + x, SQUARE * place[1] + y) for y in range(SQUARE) for x in range(SQUARE)]


def _is_same(some: Ages, others: Ages, block: Block) -> bool:
    return block in some and block in others and bool((some[block] == others[block]).all())


def of_tiles(layers: BlockLayers, look: Look, places: Iterable[Place]) -> Iterator[tuple[Place, Blocks]]:
    """The blocks of tiles."""
    known = layers.blocks(look, [block for place in places for block in _blocks(place)], LAYERS)
    return ((place, [known.get(block) for block in _blocks(place)]) for place in places)


def tile_of(place: Place, blocks: Blocks, version: MapVersion) -> MapTile:
    """A tile of layers of its blocks."""
    shape = (SQUARE, BLOCK_CELLS, SQUARE, BLOCK_CELLS)  # row and column of a cell, each by block
    values, newest_ns = np.full((len(PLANES), *shape), np.nan), np.zeros(shape, np.int64)
    for i, block in enumerate(blocks):
        if block:
            y, x = divmod(i, SQUARE)
            newest_ns[y, :, x] = block.layers["newest_ns"].reshape(BLOCK_CELLS, BLOCK_CELLS)
            for plane, name in enumerate(LAYERS[:-1]):
                values[plane, y, :, x] = block.layers[name].reshape(BLOCK_CELLS, BLOCK_CELLS)
    newest = int(newest_ns.max())
    values[-1] = np.where(newest_ns > 0, (newest - newest_ns) / 1e9, np.nan)
    planes = np.stack([scale.quantised(plane) for scale, plane in zip(PLANES.values(), values, strict=True)])
    return MapTile(*place, version.row, version.fact, newest, zlib.compress(planes.tobytes()))


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


def tiles_of(view: View, layers: BlockLayers) -> TilesAnswer:
    """All tiles of a view."""
    look = layers.look_at(view)
    tiles = tuple(
        tile_of(place, blocks, view.version)
        for some in _few(sorted({_tile_of(block) for block in look.cell_states}))
        for place, blocks in of_tiles(layers, look, some)
    )
    return TilesAnswer(view.version, view.stamp_ns, layers.cell_m, whole=True, tiles=tiles)
