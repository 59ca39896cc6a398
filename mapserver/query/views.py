"""Views: evidence of a window now or in the past, and its layers."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np

from mapserver.change.detection import reach_blocks
from mapserver.change.validity import Pages, valid_pages
from mapserver.config import ServerConfig
from mapserver.evidence.grid import Grid, chunks
from mapserver.evidence.timeline import Ages, Block, evidence
from mapserver.journal.facts import Facts
from mapserver.journal.journal import JournalReader
from mapserver.journal.location import JournalLocation
from mapserver.journal.rows import Selection
from mapserver.layers import cell_layers
from mapserver.layers.lanes import lane_tile
from mapserver.past.cell_history import CellHistory, cell_history
from mapserver.past.past import StorePast
from mapserver.query.source import MapState
from protocol.arrays import AnyArray, Floats32
from protocol.errors import QueryError, Refusal, StoreError
from protocol.queries.answers import MapVersion
from protocol.queries.lanes import LanesAnswer
from protocol.queries.map_tiles import TILE_CELLS
from protocol.site.geometry import BLOCK_CELLS, CellWindow

MOST_BLOCKS = 16_384  # of known ground per query, 4 km2 with 1 m cells: 0.2 s of the map's owner
# Present evidence [bytes] where a past map is folded, which takes up to 1.2 times of it: at most, and in a part.
PAST_BYTES, PART_BYTES = 2**27, 2**25


def check_past(state: MapState, window: CellWindow | None, reach: int) -> None:
    """Refuse a past map of too much evidence at once; window: None for all. On the map's thread."""
    area = bounds_of(state) if window is None else surroundings(window, reach)
    size = state.grid.size(state.grid.blocks_in(area))
    if size > PAST_BYTES:
        problem = f"it reads {size / 1e6:.0f} MB of evidence of the past at once, over {PAST_BYTES / 1e6:.0f}"
        instead = "ask for a `region` of a part, with `bounds` and `as_of`; or ask for the map as it is"
        raise QueryError(Refusal.TOO_LARGE, f"{problem}: {instead}")


def bounds_of(state: MapState) -> CellWindow:
    """All cells with evidence; one without any."""
    west, south, east, north = state.grid.bounds() or (0, 0, 1, 1)
    return CellWindow(west, south, east - west, north - south)


def parts_of(state: MapState, window: CellWindow) -> list[CellWindow]:
    """Parts of a window with at most PART_BYTES of evidence each, or a tile. On the map's thread."""
    size = state.grid.size(state.grid.blocks_in(window))
    if size <= PART_BYTES or max(window.columns, window.rows) <= TILE_CELLS:
        return [window]
    return [part for half in _halves(window) for part in parts_of(state, half)]


def _halves(window: CellWindow) -> tuple[CellWindow, CellWindow]:
    """Cut the longer side between tiles."""
    first, count = max((window.column, window.columns), (window.row, window.rows), key=lambda side: side[1])
    middle = max((first + count // 2) // TILE_CELLS, first // TILE_CELLS + 1) * TILE_CELLS - first
    if window.columns == count:
        east = CellWindow(window.column + middle, window.row, count - middle, window.rows)
        return CellWindow(window.column, window.row, middle, window.rows), east
    north = CellWindow(window.column, window.row + middle, window.columns, count - middle)
    return CellWindow(window.column, window.row, window.columns, middle), north


def check_blocks(count: int, instead: str) -> None:
    """Refuse a query of too much known ground, with advice."""
    if count > MOST_BLOCKS:
        n = BLOCK_CELLS
        problem = f"it reads {count} blocks ({n} x {n} cells) of known ground, over {MOST_BLOCKS}"
        raise QueryError(Refusal.TOO_LARGE, f"{problem}: {instead}")


@dataclass(frozen=True)
class View:
    """Pages of a window's blocks and those around.

    version: of their map. stamp_ns: their time. ages: of the ground of repaired roads.
    """

    pages: Pages
    version: MapVersion
    stamp_ns: int
    ages: Ages = field(default_factory=dict)


@dataclass(frozen=True)
class PastMaps:
    """Past maps of one store. Each call opens the journal, so it is thread-safe."""

    journal: JournalLocation
    past: StorePast
    config: ServerConfig

    def view(self, window: CellWindow, stamp_ns: int, facts: Facts, version: MapVersion) -> View:
        """The map from a version's samples stamped up to stamp_ns. facts: the version's."""
        reach = reach_blocks(self.past.cell_m, self.config.change)
        with self._reader(facts) as (reader, _):
            grid = self.past.grid_as_of(reader, stamp_ns, surroundings(window, reach), facts, version.row)
        pages = _pages(grid, window, reach)
        return View(pages, version, stamp_ns, facts.repairs.ages_as_of(stamp_ns, pages.keys()))

    def history(
        self, cell: tuple[int, int], times: tuple[int, int], span_ns: int, facts: Facts
    ) -> tuple[CellHistory, MapVersion]:
        """Evidence of a cell (column, row) by span between two times [ns], inclusive."""
        with self._reader(facts) as (reader, version):
            return cell_history(self.past, reader, cell, span_ns, Selection.by(facts, *times)), version

    @contextmanager
    def _reader(self, facts: Facts) -> Iterator[tuple[JournalReader, MapVersion]]:
        try:
            with self.journal.reader() as reader:
                yield reader, MapVersion(reader.identity().id, reader.last_row, facts.number)
        except StoreError as error:
            raise QueryError(Refusal.STORE, str(error)) from None


def view_now(state: MapState, window: CellWindow) -> View:
    """The present map, on its thread."""
    reach = reach_blocks(state.site.cell_m, state.config.change)
    return View(_pages(state.grid, window, reach), state.version, state.newest_ns, state.facts.repairs.ages)


def view_of(grid: Grid, window: CellWindow, config: ServerConfig) -> View:
    """The map of a grid, without a journal."""
    return View(_pages(grid, window, reach_blocks(grid.cell_m, config.change)), MapVersion("", 0, 0), grid.newest_ns)


def read_cells(
    view: View, window: CellWindow, names: tuple[str, ...], cell_m: float, config: ServerConfig
) -> dict[str, Floats32]:
    """Layers (rows, columns) of a window."""
    first = valid_pages(view.pages, cell_m, config.change, view.ages)
    shape = (window.rows, window.columns)
    out: dict[str, Floats32] = {name: np.full(shape, np.nan, np.float32) for name in names}
    for some in chunks([block for block in view.pages if _touches(block, window)]):
        sums = evidence([view.pages[block] for block in some], [first[block] for block in some])
        layers = cell_layers.read(sums, names, config.read, view.stamp_ns)
        for i, block in enumerate(some):
            place(out, window, block, {name: values[i] for name, values in layers.items()})
    return out


def read_lanes(
    view: View, window: CellWindow | None, since_ns: int | None, cell_m: float, config: ServerConfig
) -> LanesAnswer:
    """Lanes of the blocks in a window, or all (None). since_ns: only those with newer samples.

    Also of before a repair: it moves no road.
    """
    first = valid_pages(view.pages, cell_m, config.change)
    blocks = [block for block in sorted(view.pages) if window is None or _touches(block, window)]
    tiles = (lane_tile(block, view.pages[block], first[block], view.stamp_ns) for block in blocks)
    known = tuple(tile for tile in tiles if tile and (since_ns is None or tile.newest_ns > since_ns))
    return LanesAnswer(view.version, view.stamp_ns, cell_m, known)


def place(out: Mapping[str, Floats32], window: CellWindow, block: Block, layers: Mapping[str, AnyArray]) -> None:
    """Copy layers of a square of blocks, given its first one, into a window; (256,) for one block."""
    if not layers:
        return
    n = math.isqrt(next(iter(layers.values())).size)
    column, row = block[0] * BLOCK_CELLS - window.column, block[1] * BLOCK_CELLS - window.row
    left, top = max(0, -column), max(0, -row)
    right, bottom = min(n, window.columns - column), min(n, window.rows - row)
    if left < right and top < bottom:
        for name, values in layers.items():
            part = values.reshape(n, n)[top:bottom, left:right]
            out[name][row + top : row + bottom, column + left : column + right] = part


def widened(window: CellWindow, cells: int) -> CellWindow:
    """A window, wider by so many cells on each side."""
    return CellWindow(window.column - cells, window.row - cells, window.columns + 2 * cells, window.rows + 2 * cells)


def _pages(grid: Grid, window: CellWindow, reach: int) -> Pages:
    blocks = grid.blocks_in(surroundings(window, reach))
    return dict(zip(blocks, grid.pages(blocks), strict=True))


def surroundings(window: CellWindow, reach: int) -> CellWindow:
    """Cells of the blocks that a window touches, and `reach` blocks around."""
    n = BLOCK_CELLS
    left, bottom = window.column // n - reach, window.row // n - reach
    right = (window.column + window.columns - 1) // n + 1 + reach
    top = (window.row + window.rows - 1) // n + 1 + reach
    return CellWindow(left * n, bottom * n, (right - left) * n, (top - bottom) * n)


def _touches(block: Block, window: CellWindow) -> bool:
    column, row = block[0] * BLOCK_CELLS - window.column, block[1] * BLOCK_CELLS - window.row
    return -BLOCK_CELLS < column < window.columns and -BLOCK_CELLS < row < window.rows
