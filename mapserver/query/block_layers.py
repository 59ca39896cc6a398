"""Layers of the present map, cached by block for all queries while their dependencies are unchanged.

Cell layers depend on the pages of their block and of those around, because changes of the ground need context; area
layers also on cells around. The grid knows each block's last turn, so blocks without new evidence nearby are read from
the cache. The validity of neighbouring pages is checked on every read, but rarely changes: a block is recomputed only
if its own pages, or their validity, changed, a square only if a block was. Area layers are computed by square, hence
the same for any window, bit for bit. Ages of repaired roads count as evidence: a new one begins a turn of its blocks.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, field
from itertools import count, product
from typing import NamedTuple
from weakref import ReferenceType, ref

import cv2
import numpy as np

from mapserver.change.detection import reach_blocks
from mapserver.change.validity import Pages, around, valid_pages
from mapserver.config import ServerConfig
from mapserver.evidence.grid import Grid, chunks
from mapserver.evidence.timeline import Ages, Block, evidence
from mapserver.layers import cell_layers
from mapserver.layers.gap_filling import AREA_LAYERS
from mapserver.query.source import MapState
from mapserver.query.views import View, check_blocks, place
from protocol.arrays import AnyArray, Floats, Floats32, Ints
from protocol.queries.answers import MapVersion
from protocol.site.geometry import BLOCK_CELLS, CellWindow

MOST_KEPT = 98_304  # layers of blocks, 1 KB each: seven of a fully driven site of 1.9 x 1.9 km
SQUARE = 4  # blocks to a side; larger squares cost less in total, more for little new evidence
SQUARE_CELLS = SQUARE * BLOCK_CELLS
SQUARES_AT_ONCE = 64  # whose cell layers are in memory: 1000 blocks, some 20 MB
MOST_IMAGE = 2**20  # blocks, 8 MB: 16 x 16 km with 1 m cells
NEVER = -1  # turn of a block without evidence
# layers that follow from cached stamps and the site's now
TIMED = {"age_s": "newest_ns", "changed_s": "changed_ns"}
Layers = Mapping[str, AnyArray]  # (256,) each, or of a square


class Kept(NamedTuple):
    """Layers of a block or square, and the last turn of all blocks they depend on.

    origin: of a block, its last turn and first valid pages (256,), if not all; of a square, the numbers of its blocks.
    number: identifies an origin.
    """

    turn: int
    layers: Layers
    origin: tuple[object, ...]
    number: int = NEVER


@dataclass(frozen=True)
class Look:
    """Sources of a window's layers in one map version: cached layers, and pages of the rest.

    cells, areas: cached, of these turns or older; cell_turns, area_turns: as in Kept, of blocks with evidence, and of
    squares near any. turns: of blocks alone. pages: of blocks without valid layers, and around. ages: as in View.
    """

    version: MapVersion
    stamp_ns: int
    cells: Mapping[Block, Kept]
    areas: Mapping[Block, Kept]
    cell_turns: Mapping[Block, int]
    area_turns: Mapping[Block, int]
    turns: Mapping[Block, int]
    pages: Pages
    grid: ReferenceType[Grid] | None = None
    ages: Ages = field(default_factory=dict)


class BlockLayers:
    """Layers of one map. `look` on the map's thread; `read` on any, repeatedly."""

    def __init__(self, cell_m: float, config: ServerConfig, most: int = MOST_KEPT) -> None:
        """most: cached layers of blocks."""
        self.cell_m, self._config, self._most = cell_m, config, most
        self._reach = reach_blocks(cell_m, config.change)
        self._lock = threading.Lock()
        self._cells: OrderedDict[Block, Kept] = OrderedDict()
        self._areas: OrderedDict[Block, Kept] = OrderedDict()
        self._count = 0  # layers of blocks in both
        self._grid: ReferenceType[Grid] | None = None
        self._numbers = count()
        self.used, self.derived = 0, 0  # blocks and squares from the cache, and derived ones

    def look(self, state: MapState, window: CellWindow, names: Sequence[str]) -> Look:
        """Sources of these layers of a window."""
        area_names, inner = _areas_of(names), _blocks_of(window)
        return self._look(state, inner, _stored(names), squares_of(window) if area_names else set(), area_names)

    def kept_cell(self, state: MapState, cell: Block, names: Sequence[str]) -> dict[str, float] | None:
        """Layers of a cell (column, row) of the present map, if all are cached, as for most points."""
        (column, row), n = cell, BLOCK_CELLS
        block = column // n, row // n
        turn = max(state.grid.last_turns(around(block, self._reach)))
        with self._lock:
            kept = self._cells.get(block) if self._grid and self._grid() is state.grid else None
            if kept is None or kept.turn != turn or any(TIMED.get(n, n) not in kept.layers for n in names):
                return None
            self._cells.move_to_end(block)
            self.used += 1
        at = row % n * n + column % n
        now_ns = state.newest_ns
        return {name: float(np.float32(_at(kept.layers, name, now_ns)[at])) for name in names}

    def look_squares(self, state: MapState, squares: Set[Block], names: Sequence[str]) -> Look:
        """Sources of area layers in squares."""
        return self._look(state, _blocks_of(around_squares(squares)), (), squares, tuple(names))

    def look_cells(self, state: MapState, cells: Ints, names: Sequence[str]) -> Look:
        """Sources of these layers of cells (n, 2) [column, row]."""
        return self.look_blocks(state, _blocks_with(cells), names)

    def look_blocks(self, state: MapState, blocks: Set[Block], names: Sequence[str]) -> Look:
        """Sources of these layers of blocks, and of area layers in their squares."""
        area_names = _areas_of(names)
        squares = {(x // SQUARE, y // SQUARE) for x, y in blocks} if area_names else set[Block]()
        return self._look(state, _around_all(blocks), _stored(names), squares, area_names, blocks)

    def _look(
        self,
        state: MapState,
        inner: Rect,
        cell_names: tuple[str, ...],
        squares: Set[Block],
        area_names: tuple[str, ...],
        only: Set[Block] | None = None,
    ) -> Look:
        """Cell layers in a rectangle of blocks, or in some; area layers in squares that touch it."""
        grid, margin = state.grid, self._margin(area_names)
        ages, owner = state.facts.repairs.ages, ref(grid)
        whole = _of_squares(_squares_of(inner)) if squares else inner
        wide = _grown(whole, margin + self._reach)
        blocks = grid.blocks_in(_cells_of(wide))
        of_cells = blocks if only is None else _near(dict.fromkeys(blocks, 0), only, wide, self._reach)
        of_squares = {(x // SQUARE, y // SQUARE) for x, y in blocks} & squares if squares else set[Block]()
        work = (len(of_cells) if cell_names else 0) + SQUARE**2 * len(of_squares)
        check_blocks(work, "ask for less ground, or for fewer places, at once")
        own = dict(zip(blocks, grid.last_turns(blocks), strict=True))
        cell_turns, area_turns = _newest(own, wide, self._reach, margin, squares)
        with self._lock:
            if self._grid is None or self._grid() is not owner():  # a fact, or lost rows, replace the grid
                self._cells.clear()
                self._areas.clear()
                self._grid, self._count = owner, 0
            areas = _valid(self._areas, area_turns, area_names)
            stale = area_turns.keys() - areas.keys()
            areas |= _some(self._areas, stale)
            needed = self._around(stale, area_names)
            needed_names = (*cell_names, *(cell_layers.required(area_names) if needed else ()))
            asked = only if only is not None else _within(cell_turns, inner).keys() if cell_names else set[Block]()
            wanted = {block: turn for block, turn in cell_turns.items() if block in needed or block in asked}
            cells = _valid(self._cells, wanted, needed_names)
            missing = wanted.keys() - cells.keys()
            cells |= _some(self._cells, missing)
        near = _near(own, missing, wide, self._reach)
        pages = dict(zip(near, grid.pages(near), strict=True))
        return Look(state.version, state.newest_ns, cells, areas, cell_turns, area_turns, own, pages, owner, ages)

    def look_at(self, view: View) -> Look:
        """Sources of a past map, without cache."""
        turns = {block: 0 for block, pages in view.pages.items() if pages}
        near = {one for block in turns for one in around(block, self._margin(tuple(AREA_LAYERS)))}
        squares = dict.fromkeys({(x // SQUARE, y // SQUARE) for x, y in near}, 0)
        return Look(view.version, view.stamp_ns, {}, {}, turns, squares, turns, view.pages, ages=view.ages)

    def read(self, look: Look, window: CellWindow, names: Sequence[str]) -> dict[str, Floats32]:
        """Layers (rows, columns) of a window inside the look's."""
        cell_names, area_names, inner = _stored(names), _areas_of(names), _blocks_of(window)
        areas = self.squares(look, squares_of(window), area_names) if area_names else {}
        blocks = _within(look.cell_turns, inner) if cell_names else ()
        cells = self.blocks(look, blocks, cell_names)
        out: dict[str, Floats32] = {name: np.full((window.rows, window.columns), np.nan, np.float32) for name in names}
        for square, layers in areas.items():
            place_square(out, window, square, {name: layers[name] for name in area_names})
        plain = [name for name in names if name not in AREA_LAYERS]
        for block, kept in cells.items():
            place(out, window, block, {name: _at(kept.layers, name, look.stamp_ns) for name in plain})
        return out

    def at_cells(self, look: Look, cells: Ints, names: Sequence[str]) -> dict[str, Floats32]:
        """Layers (n,) of cells (n, 2) [column, row] of the look."""
        out: dict[str, Floats32] = {name: np.full(len(cells), np.nan, np.float32) for name in names}
        parts = [at for _, at in _by_part(cells, SQUARE_CELLS)]
        for first in range(0, len(parts), SQUARES_AT_ONCE):
            at = np.concatenate(parts[first : first + SQUARES_AT_ONCE])
            for name, values in self._at_few_cells(look, cells[at], names).items():
                out[name][at] = values
        return out

    def _at_few_cells(self, look: Look, cells: Ints, names: Sequence[str]) -> dict[str, Floats32]:
        cell_names, area_names, asked = _stored(names), _areas_of(names), _blocks_with(cells)
        blocks = self.blocks(look, asked, cell_names) if cell_names else {}
        of_blocks = {
            block: {name: _at(kept.layers, name, look.stamp_ns) for name in names if name not in area_names}
            for block, kept in blocks.items()
        }
        near = {(x // SQUARE, y // SQUARE) for x, y in asked}
        squares = self.squares(look, near, area_names) if area_names else {}
        out: dict[str, Floats32] = {name: np.full(len(cells), np.nan, np.float32) for name in names}
        for edge, kept, some in (
            (BLOCK_CELLS, of_blocks, set(names) - set(area_names)),
            (SQUARE_CELLS, squares, area_names),
        ):
            for part, at in _by_part(cells, edge) if some else ():
                if part in kept:
                    column, row = (cells[at] % edge).T
                    inside = row * edge + column
                    for name in some:
                        out[name][at] = kept[part][name].reshape(-1)[inside]
        return out

    def squares(self, look: Look, squares: Set[Block], names: Sequence[str]) -> dict[Block, Layers]:
        """Layers (SQUARE_CELLS, SQUARE_CELLS) of squares with evidence nearby."""
        wanted = {square: turn for square, turn in look.area_turns.items() if square in squares}
        areas = _valid(look.areas, wanted, names)
        stale = sorted(wanted.keys() - areas.keys())
        made, derived = dict[Block, Kept](), 0
        for first in range(0, len(stale), SQUARES_AT_ONCE):
            some = stale[first : first + SQUARES_AT_ONCE]
            cells = self.blocks(look, self._around(some, names), cell_layers.required(names))
            for square in some:
                old, origin = look.areas.get(square), self._origin_of(square, cells, names)
                layers = old.layers if old and old.origin == origin else {}
                if any(name not in layers for name in names):
                    layers, derived = {**layers, **self._derive(square, cells, names)}, derived + 1
                made[square] = Kept(wanted[square], layers, origin)
        self._keep(self._areas, look, made)
        self._note(len(wanted) - derived, derived)
        return {square: kept.layers for square, kept in (areas | made).items()}

    def _origin_of(self, square: Block, cells: Mapping[Block, Kept], names: Sequence[str]) -> tuple[int, ...]:
        """Numbers of the blocks that a square is derived from."""
        near = sorted(self._around([square], names))
        return tuple(cells[block].number if block in cells else NEVER for block in near)

    def _margin(self, names: Sequence[str]) -> int:
        """Blocks around one that area layers depend on."""
        return -(-cell_layers.margin_cells(names, self.cell_m, self._config.read) // BLOCK_CELLS)

    def blocks(self, look: Look, asked: Iterable[Block], names: Sequence[str]) -> dict[Block, Kept]:
        """Cell layers of blocks with evidence, cached or derived."""
        blocks = {block: look.cell_turns[block] for block in asked if block in look.cell_turns}
        known = _some(look.cells, blocks)
        with self._lock:
            if look.grid is not None and look.grid is self._grid:  # cached meanwhile, by other queries or pieces
                known |= _some(self._cells, blocks)
        cells = _valid(known, blocks, names)
        missing = [block for block in blocks if block not in cells]
        near = {one for block in missing for one in around(block, self._reach) if one in look.pages}
        pages = {block: look.pages[block] for block in sorted(near)}
        first = valid_pages(pages, self.cell_m, self._config.change, look.ages, only=missing)
        made: dict[Block, Kept] = {}
        for block in missing:
            old, origin = known.get(block), (look.turns[block], *_beginning(first[block]))
            same = old if old and old.origin == origin else Kept(blocks[block], {}, origin, next(self._numbers))
            made[block] = same._replace(turn=blocks[block])
        lacking = [block for block in missing if any(name not in made[block].layers for name in names)]
        for some in chunks(lacking):
            sums = evidence([look.pages[block] for block in some], [first[block] for block in some])
            plain = [name for name in dict.fromkeys((*names, "weight")) if name not in TIMED.values()]
            values: dict[str, AnyArray] = {**cell_layers.read(sums, plain, self._config.read)}
            for name in set(names).intersection(TIMED.values()):
                values[name] = np.where(np.isnan(values["weight"]), 0, getattr(sums, name))
            for i, block in enumerate(some):
                more = {name: layer[i].copy() for name, layer in values.items()}  # a view would keep all of them
                made[block] = made[block]._replace(layers={**made[block].layers, **more})
        self._keep(self._cells, look, made)
        self._note(len(blocks) - len(lacking), len(lacking))
        return cells | made

    def _around(self, squares: Iterable[Block], names: Sequence[str]) -> set[Block]:
        """Blocks that area layers in squares depend on."""
        margin = self._margin(names)
        return {block for x, y in squares for block in _all_of(_grown(_of_squares((x, y, 1, 1)), margin))}

    def _derive(self, square: Block, cells: Mapping[Block, Kept], names: Sequence[str]) -> Layers:
        """Area layers in a square, from cell layers in and around it."""
        reach = cell_layers.margin_cells(names, self.cell_m, self._config.read)
        edge = SQUARE_CELLS
        wide = CellWindow(square[0] * edge - reach, square[1] * edge - reach, edge + 2 * reach, edge + 2 * reach)
        shape = (wide.rows, wide.columns)
        needs = {name: np.full(shape, np.nan, np.float32) for name in cell_layers.required(names)}
        for near in self._around([square], names):
            if kept := cells.get(near):
                place(needs, wide, near, {name: kept.layers[name] for name in needs})
        made = cell_layers.derive_area(names, needs, self.cell_m, self._config.read)
        inside = slice(reach, reach + edge)
        return {name: np.ascontiguousarray(layer[inside, inside]) for name, layer in made.items()}

    def _note(self, used: int, derived: int) -> None:
        with self._lock:
            self.used, self.derived = self.used + used, self.derived + derived

    def _keep(self, store: OrderedDict[Block, Kept], look: Look, made: Mapping[Block, Kept]) -> None:
        """Cache layers, unless the map was replaced; drops the least recently used."""
        with self._lock:
            if look.grid is None or look.grid is not self._grid:
                return
            for block, kept in made.items():
                old = store.get(block)
                if old and old.turn > kept.turn:
                    continue
                layers = {**old.layers, **kept.layers} if old and old.turn == kept.turn else kept.layers
                if not old or layers is not old.layers:
                    self._count += _size(layers) - (_size(old.layers) if old else 0)
                store[block] = kept._replace(layers=layers)
                store.move_to_end(block)
            while self._count > self._most:
                fuller = self._areas if SQUARE**2 * len(self._areas) > len(self._cells) else self._cells
                self._count -= _size(fuller.popitem(last=False)[1].layers)


def _beginning(first: Ints) -> tuple[bytes, ...]:
    """First valid pages of a block (256,), for comparison."""
    return (first.tobytes(),) if first.any() else ()


def _some(kept: Mapping[Block, Kept], blocks: Iterable[Block]) -> dict[Block, Kept]:
    """Cached blocks, of any turn."""
    return {block: kept[block] for block in blocks if block in kept}


def _stored(names: Iterable[str]) -> tuple[str, ...]:
    """Cell layers as cached."""
    return tuple(dict.fromkeys(TIMED.get(name, name) for name in names if name not in AREA_LAYERS))


def _areas_of(names: Iterable[str]) -> tuple[str, ...]:
    return tuple(name for name in names if name in AREA_LAYERS)


def _size(layers: Layers) -> int:
    """In layers of blocks."""
    return sum(layer.size // BLOCK_CELLS**2 for layer in layers.values())


def _at(layers: Layers, name: str, now_ns: int) -> Floats | Floats32:
    """A layer (256,) as of now."""
    if name in TIMED:
        return cell_layers.seconds_ago(layers[TIMED[name]], np.array(now_ns))
    return layers[name]


def _valid(kept: Mapping[Block, Kept], turns: Mapping[Block, int], names: Sequence[str]) -> dict[Block, Kept]:
    """Cached blocks of these turns, with all these layers; marks them as used."""
    out = {}
    for block, turn in turns.items():
        one = kept.get(block)
        if one and one.turn == turn and all(name in one.layers for name in names):
            out[block] = one
            if isinstance(kept, OrderedDict):
                kept.move_to_end(block)
    return out


# --- rectangles of blocks or squares: first column, first row, number of columns, of rows ----------------------------


Rect = tuple[int, int, int, int]


def _blocks_with(cells: Ints) -> set[Block]:
    """Blocks of cells (n, 2)."""
    return {part for part, _ in _by_part(cells, BLOCK_CELLS)}


def _by_part(cells: Ints, edge: int) -> list[tuple[Block, Ints]]:
    """Squares of cells, and the indices of the cells (n, 2) in each."""
    parts = cells // edge
    order = np.lexsort(parts.T)
    first = np.flatnonzero(np.append(True, (np.diff(parts[order], axis=0) != 0).any(axis=1)))
    return list(zip(map(tuple, parts[order[first]].tolist()), np.split(order, first[1:]), strict=True))


def _parts_of(rect: Rect, edge: int) -> Rect:
    """The larger squares that a rectangle touches."""
    left, bottom = rect[0] // edge, rect[1] // edge
    return left, bottom, (rect[0] + rect[2] - 1) // edge - left + 1, (rect[1] + rect[3] - 1) // edge - bottom + 1


def _blocks_of(window: CellWindow) -> Rect:
    return _parts_of((window.column, window.row, window.columns, window.rows), BLOCK_CELLS)


def squares_of(window: CellWindow) -> set[Block]:
    """Squares (column, row) that a window touches."""
    return set(_all_of(_squares_of(_blocks_of(window))))


def around_squares(squares: Set[Block]) -> CellWindow:
    """The window of squares."""
    return _cells_of(_of_squares(_around_all(squares)))


def _around_all(blocks: Iterable[Block]) -> Rect:
    """Smallest rectangle around blocks or squares."""
    columns, rows = zip(*blocks, strict=True)
    left, bottom = min(columns), min(rows)
    return left, bottom, max(columns) - left + 1, max(rows) - bottom + 1


def _squares_of(blocks: Rect) -> Rect:
    return _parts_of(blocks, SQUARE)


def _of_squares(squares: Rect) -> Rect:
    return squares[0] * SQUARE, squares[1] * SQUARE, squares[2] * SQUARE, squares[3] * SQUARE


def _cells_of(rect: Rect) -> CellWindow:
    return CellWindow(*(BLOCK_CELLS * value for value in rect))


def _grown(rect: Rect, by: int) -> Rect:
    return rect[0] - by, rect[1] - by, rect[2] + 2 * by, rect[3] + 2 * by


def _is_in(block: Block, rect: Rect) -> bool:
    return 0 <= block[0] - rect[0] < rect[2] and 0 <= block[1] - rect[1] < rect[3]


def _all_of(rect: Rect) -> Iterable[Block]:
    return product(range(rect[0], rect[0] + rect[2]), range(rect[1], rect[1] + rect[3]))


def _within(turns: Mapping[Block, int], rect: Rect) -> dict[Block, int]:
    return {block: turn for block, turn in turns.items() if _is_in(block, rect)}


def _newest(
    own: Mapping[Block, int], wide: Rect, reach: int, margin: int, squares: Set[Block]
) -> tuple[dict[Block, int], dict[Block, int]]:
    """Newest turn of each block and those around; and in and around each square, if any."""
    if _is_sparse(wide):
        cells = {block: max(own.get(one, NEVER) for one in around(block, reach)) for block in own}
        of_squares = ((square, _all_of(_grown(_of_squares((*square, 1, 1)), margin + reach))) for square in squares)
        areas = {square: max(own.get(block, NEVER) for block in near) for square, near in of_squares}
        return cells, {square: turn for square, turn in areas.items() if turn > NEVER}
    at, image = _image(own, wide)
    image = _spread(image, reach)
    cells = dict(zip(own, image[at].astype(int).tolist(), strict=True))
    return cells, _by_square(_spread(image, margin), wide, squares) if squares else {}


def _near(own: Mapping[Block, int], missing: Set[Block], wide: Rect, reach: int) -> list[Block]:
    """Own blocks that are among or around missing ones."""
    if _is_sparse(wide):
        return sorted({one for block in missing for one in around(block, reach)} & own.keys())
    _, image = _image(dict.fromkeys(missing, 0), wide)
    at, _ = _image(own, wide)
    is_near = _spread(image, reach)[at] > NEVER
    return [block for block, near in zip(own, is_near.tolist(), strict=True) if near]


def _is_sparse(rect: Rect) -> bool:
    """Whether an image would be too large: places far apart."""
    return rect[2] * rect[3] > MOST_IMAGE


def _image(turns: Mapping[Block, int], rect: Rect) -> tuple[tuple[Ints, Ints], Floats]:
    """Turns of blocks as an image (rows, columns), NEVER elsewhere; and their places in it."""
    places = np.array(list(turns), np.int64).reshape(-1, 2) - rect[:2]
    at, image = (places[:, 1], places[:, 0]), np.full((rect[3], rect[2]), float(NEVER))
    image[at] = list(turns.values())
    return at, image


def _spread(image: Floats, reach: int) -> Floats:
    """Newest turn of each block and those around."""
    square = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    return np.asarray(cv2.dilate(image, square, borderValue=NEVER), np.float64)


def _by_square(image: Floats, rect: Rect, squares: Set[Block]) -> dict[Block, int]:
    """Newest turn in each square of the rectangle, if any."""
    first_x, first_y = -rect[0] % SQUARE, -rect[1] % SQUARE
    rows, columns = (image.shape[0] - first_y) // SQUARE, (image.shape[1] - first_x) // SQUARE
    whole = image[first_y : first_y + rows * SQUARE, first_x : first_x + columns * SQUARE]
    newest = whole.reshape(rows, SQUARE, columns, SQUARE).max(axis=(1, 3))
    left, bottom = (rect[0] + first_x) // SQUARE, (rect[1] + first_y) // SQUARE
    turns = {(x, y): int(newest[y - bottom, x - left]) for x, y in squares}
    return {square: turn for square, turn in turns.items() if turn > NEVER}


def place_square(out: Mapping[str, Floats32], window: CellWindow, square: Block, layers: Layers) -> None:
    """Copy layers (64, 64) of a square into a window."""
    place(out, window, (square[0] * SQUARE, square[1] * SQUARE), layers)
