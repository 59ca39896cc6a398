"""Tiles of the map as it is, kept and brought up to date where evidence came in; and of the map as of any time.

A tile is a function of the evidence and of the ages of roads: the age of a cell is counted from the tile's newest
sample, so that time alone changes no tile. Ages of roads are those of some seconds ago, as a page asks ten times a
second; they enter together with new rows, which readers ask for.
"""

from __future__ import annotations

import threading
import zlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from weakref import ReferenceType, ref

import numpy as np

from mapserver.change.detection import reach_blocks
from mapserver.change.validity import Ages, Pages, around, valid_pages
from mapserver.config import ServerConfig
from mapserver.evidence.grid import Grid, chunks
from mapserver.evidence.timeline import Block, evidence
from mapserver.layers import cell_layers
from mapserver.query.region_pieces import PIECE_BYTES
from mapserver.query.source import MapSource, MapState
from mapserver.query.views import View
from protocol.arrays import AnyArray, Ints
from protocol.queries.answers import MapVersion
from protocol.queries.map_tiles import PLANES, TILE_CELLS, MapTile, Plane, TilesAnswer, TilesQuery
from protocol.site.geometry import BLOCK_CELLS

BLOCKS = TILE_CELLS // BLOCK_CELLS  # of a tile, along one side
LEVEL = 6  # of deflate: 9 takes three times as long for 1 % less
LAYERS = ("resistance", "confidence", "grade", "grade_std", "visits")  # as in PLANES; `since` is of the evidence
TILE_HEAD_BYTES = 64  # of a tile beside its planes, at most
Place = tuple[int, int]  # column and row of a tile


@dataclass
class _Square:
    """A tile in the making. planes: (planes, 64, 64). newest_ns: (64, 64), 0 for none."""

    planes: Plane
    newest_ns: Ints

    @classmethod
    def empty(cls) -> _Square:
        planes = np.zeros((len(PLANES), TILE_CELLS, TILE_CELLS), np.uint8)
        return cls(planes, np.zeros((TILE_CELLS, TILE_CELLS), np.int64))

    def tile(self, place: Place, row: int, fact: int) -> MapTile:
        newest_ns = int(self.newest_ns.max())
        since_s = np.where(self.newest_ns > 0, (newest_ns - self.newest_ns) / 1e9, np.nan)
        self.planes[-1] = PLANES["since"].quantised(since_s)
        return MapTile(*place, row, fact, newest_ns, zlib.compress(self.planes.tobytes(), LEVEL))


class Tiles:
    """Tiles of the map as it is; for any thread. What it costs is for what changed since somebody last asked."""

    def __init__(self, source: MapSource, ages: Callable[[], Ages]) -> None:
        """ages: since when cells of roads are as they are, lately."""
        self._source, self._config, self._lately = source, source.config, ages
        self._cell_m = source.site.cell_m
        self._reach = reach_blocks(self._cell_m, self._config.change)
        self._lock = threading.Lock()
        self._squares: dict[Place, _Square] = {}
        self._tiles: dict[Place, MapTile] = {}
        self._holding: dict[Block, bytes] = {}  # the pages of blocks that hold, where not all do
        self._turn, self._fact, self._row = -1, -1, 0
        self._ages: Ages = {}
        self._grid: ReferenceType[Grid] | None = None  # the last one; a fact may bring another one

    def answer(self, query: TilesQuery) -> TilesAnswer:
        """Tiles that differ since the version that the query names; all where it names none of this store."""
        with self._lock:
            version, stamp_ns = self._update()
            since = query.since
            whole = (
                since is None or since.store != version.store or since.row > version.row or since.fact > version.fact
            )
            tiles = tuple(tile for tile in self._tiles.values() if whole or _is_newer(tile, since))
            return cut(TilesAnswer(version, stamp_ns, self._cell_m, whole, tiles), query.place)

    def _update(self) -> tuple[MapVersion, int]:
        """Make anew what evidence came into, and what lies so near that a change of the ground there counts for it."""
        ages = self._lately()
        blocks, folded, pages, whole, version, stamp_ns = self._source.run(lambda state: self._folded(state, ages))
        if version.row < self._row:  # rows are gone: what was said of them differs from no version
            self._tiles = {}
        squares: dict[Place, _Square] = {} if whole else self._squares
        first = valid_pages(pages, self._cell_m, self._config.change, self._ages)
        holding = {block: first[block].tobytes() if first[block].any() else b"" for block in blocks}
        others = [
            block for block in blocks if block in folded or holding[block] != self._holding.get(block, b"") or whole
        ]
        changed = fill(squares, pages, first, others, self._config)
        self._holding = ({} if whole else self._holding) | holding
        for place in changed | (self._tiles.keys() - squares.keys()):
            tile = squares.setdefault(place, _Square.empty()).tile(place, version.row, version.fact)
            known = self._tiles.get(place)
            # what evidence came into is another one, though its bytes are not: `Client.watch` reads finer values
            if not whole or known is None or (known.planes, known.newest_ns) != (tile.planes, tile.newest_ns):
                self._tiles[place] = tile
        self._squares, self._fact, self._row = squares, version.fact, version.row
        return version, stamp_ns

    def _folded(self, state: MapState, ages: Ages) -> tuple[list[Block], set[Block], Pages, bool, MapVersion, int]:
        """Blocks that may be others, those of them that evidence came into, and pages of all that lies around them."""
        grid, known_grid = state.grid, self._grid and self._grid()
        whole = state.version.fact != self._fact or grid is not known_grid
        aged: list[Block] = []
        if whole or state.version.row != self._row:
            aged = [block for block in ages.keys() | self._ages.keys() if not _is_same(ages, self._ages, block)]
            self._ages = ages
        folded, self._turn = grid.folded_since(-1 if whole else self._turn)
        self._grid = ref(grid)
        blocks = folded if whole else sorted({*aged, *(near for one in folded for near in around(one, self._reach))})
        wide = blocks if whole else sorted({near for block in blocks for near in around(block, self._reach)})
        pages = {block: pages for block, pages in zip(wide, grid.pages(wide), strict=True) if pages}
        known = [block for block in blocks if block in pages]
        return known, set(folded), pages, whole, state.version, state.newest_ns


def _is_same(some: Ages, others: Ages, block: Block) -> bool:
    return block in some and block in others and bool((some[block] == others[block]).all())


def _is_newer(tile: MapTile, since: MapVersion | None) -> bool:
    return since is None or tile.row > since.row or tile.fact > since.fact


def cut(answer: TilesAnswer, place: Place | None) -> TilesAnswer:
    """What of an answer fits into one reply, from a place on: readers are never sent more than they ask for."""
    tiles = sorted((tile for tile in answer.tiles if place is None or (tile.x, tile.y) >= place), key=_place)
    ends = np.cumsum([len(tile.planes) + TILE_HEAD_BYTES for tile in tiles])
    fit = max(1, int(np.searchsorted(ends, PIECE_BYTES, side="right")))
    next_place = _place(tiles[fit]) if fit < len(tiles) else None
    return replace(answer, tiles=tuple(tiles[:fit]), next_place=next_place)


def _place(tile: MapTile) -> Place:
    return tile.x, tile.y


def tiles_of(view: View, cell_m: float, config: ServerConfig) -> TilesAnswer:
    """All tiles of a view."""
    version = view.version
    squares: dict[Place, _Square] = {}
    fill(squares, view.pages, valid_pages(view.pages, cell_m, config.change), view.pages, config)
    tiles = tuple(square.tile(place, version.row, version.fact) for place, square in sorted(squares.items()))
    return TilesAnswer(version, view.stamp_ns, cell_m, whole=True, tiles=tiles)


def fill(
    squares: dict[Place, _Square],
    pages: Pages,
    first: Mapping[Block, Ints],
    blocks: Iterable[Block],
    config: ServerConfig,
) -> set[Place]:
    """Write blocks into their squares, each from its first page that holds on; returns which squares these are."""
    places = set()
    for some in chunks(list(blocks)):
        sums = evidence([pages[block] for block in some], [first[block] for block in some])
        values = cell_layers.read(sums, LAYERS, config.read)
        planes = np.stack([PLANES[name].quantised(layer.astype(np.float64)) for name, layer in values.items()])
        newest_ns = np.where(np.isnan(values["visits"]), 0, sums.newest_ns)
        for index, block in enumerate(some):
            places.add(_put(squares, block, planes[:, index], newest_ns[index]))
    return places


def _put(squares: dict[Place, _Square], block: Block, planes: Plane, newest_ns: AnyArray) -> Place:
    """Write one block: planes (layers, 256), newest_ns (256,)."""
    place = block[0] // BLOCKS, block[1] // BLOCKS
    square = squares.setdefault(place, _Square.empty())
    column, row = (BLOCK_CELLS * (at % BLOCKS) for at in block)
    rows, columns = slice(row, row + BLOCK_CELLS), slice(column, column + BLOCK_CELLS)
    square.planes[: len(planes), rows, columns] = planes.reshape(-1, BLOCK_CELLS, BLOCK_CELLS)
    square.newest_ns[rows, columns] = newest_ns.reshape(BLOCK_CELLS, BLOCK_CELLS)
    return place
