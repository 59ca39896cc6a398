"""The grid in memory: 16 x 16 cell blocks, each with its pages by time, where somebody drove. One thread owns it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from mapserver.evidence import cells as ev
from mapserver.evidence.fold import fold
from mapserver.evidence.open_blocks import NoRoom, OpenBlocks, split_code
from mapserver.evidence.pages import Page
from mapserver.evidence.sums import evidence
from mapserver.evidence.timeline import Block, TimedPage, Timeline, tiers
from mapserver.evidence.votes import FoldConfig
from protocol.arrays import Table
from protocol.machine.samples import SAMPLE_DTYPE
from protocol.site.geometry import BLOCK_CELLS, CellWindow

OPEN_BLOCKS = 128  # of 115 kB each: a fleet at work drives in about so many before they are packed
PIECE = 4096  # samples that are folded at once; their weights together stay far below COUNT_MAX
READ_BLOCKS = 32  # summed at once: 7 MB, which stays in the processor's cache


@dataclass(frozen=True)
class PlacedPage:
    """A page, and where it belongs: the block's column and row, the tier of its timeline and the index there."""

    x: int
    y: int
    tier: int
    index: int
    page: Page


@dataclass(frozen=True)
class GridState:
    """Everything that a snapshot keeps; equal grids have equal states. newest_ns: of all samples, 0 for none."""

    pages: tuple[PlacedPage, ...]
    folded: int
    skipped: int
    newest_ns: int


class Grid:
    """Evidence of one site.

    folded, skipped: how many samples voted, and how many were too uncertain of their position to vote. newest_ns: the
    newest stamp of all of them.
    """

    def __init__(self, cell_m: float, config: FoldConfig, open_blocks: int = OPEN_BLOCKS) -> None:
        """open_blocks: so many blocks are unpacked at a time; they are no part of what the grid says."""
        self.cell_m = cell_m
        self.config = config
        self.folded = 0
        self.skipped = 0
        self.newest_ns = 0
        self._tiers = tiers(config)
        self._open = OpenBlocks(open_blocks)
        self._timelines: dict[Block, Timeline] = {}
        self._touched: set[Block] = set()

    def fold(self, rows: Table, machine: str) -> None:
        """Fold samples of one machine; commutative, not idempotent: exactly-once is decided at the journal."""
        if len(rows):
            self.newest_ns = max(self.newest_ns, int(rows["stamp_ns"].max()))
        for first in range(0, len(rows), PIECE):
            self._fold_piece(rows[first : first + PIECE], machine)

    def blocks_in(self, window: CellWindow) -> list[Block]:
        """Block columns and rows with evidence that the window touches."""
        self._drain()
        first_x, last_x = window.column // BLOCK_CELLS, (window.column + window.columns - 1) // BLOCK_CELLS
        first_y, last_y = window.row // BLOCK_CELLS, (window.row + window.rows - 1) // BLOCK_CELLS
        return sorted((x, y) for x, y in self._timelines if first_x <= x <= last_x and first_y <= y <= last_y)

    def pages(self, blocks: Iterable[Block]) -> list[list[TimedPage]]:
        """Pages of each of these blocks in the order of time, none for a block without evidence."""
        self._drain()
        return [self._timelines[block].timed() if block in self._timelines else [] for block in blocks]

    def touch_all(self) -> None:
        """Count all blocks as touched."""
        self._drain()
        self._touched |= set(self._timelines)

    def take_touched(self, most: int) -> list[Block]:
        """Some of the blocks that were folded into, each once until it is folded into again."""
        self._drain()
        return [self._touched.pop() for _ in range(min(most, len(self._touched)))]

    def evidence(self, blocks: Iterable[Block]) -> ev.Evidence:
        """Everything that was ever seen of these blocks, whether it still holds or not."""
        return evidence(self.pages(blocks))

    def bounds(self) -> tuple[int, int, int, int] | None:
        """First column, first row, end column, end row of all blocks with evidence."""
        self._drain()
        if not self._timelines:
            return None
        xs, ys = zip(*self._timelines, strict=True)
        n = BLOCK_CELLS
        return min(xs) * n, min(ys) * n, (max(xs) + 1) * n, (max(ys) + 1) * n

    def known_cells(self) -> int:
        """How many cells have any evidence."""
        self._drain()
        known = np.zeros(ev.CELLS, np.bool_)
        total = 0
        for timeline in self._timelines.values():
            known[:] = False
            for _, _, page in timeline.items():
                known[page.cells["cell"]] = True
            total += int(known.sum())
        return total

    def state(self) -> GridState:
        """Everything, in the order of places, so that equal grids have equal states."""
        self._drain()
        pages = (
            PlacedPage(x, y, tier, index, page)
            for x, y in sorted(self._timelines)
            for tier, index, page in self._timelines[x, y].items()
        )
        return GridState(tuple(pages), self.folded, self.skipped, self.newest_ns)

    @classmethod
    def from_state(cls, cell_m: float, config: FoldConfig, state: GridState) -> Grid:
        """Undo `state`."""
        grid = cls(cell_m, config)
        for at in state.pages:
            grid._timeline((at.x, at.y)).put(at.tier, at.index, at.page)
        grid.folded, grid.skipped, grid.newest_ns = state.folded, state.skipped, state.newest_ns
        return grid

    def _fold_piece(self, rows: Table, machine: str) -> None:
        """Fold rows; where the open blocks have no room for all, first one half by place, then the other."""
        weight = int(rows["distance_m"].sum(dtype=np.float64) * ev.WEIGHT_UNITS_PER_M) + len(rows)
        if self._open.load + weight > ev.COUNT_MAX:
            self._drain()
        try:
            folded = fold(rows, machine, self.cell_m, self.config, self._open)
        except NoRoom as error:
            self._make_room(rows, machine, error.blocks)
            return
        self._open.load += weight
        self.folded += folded
        self.skipped += len(rows) - folded

    def _make_room(self, rows: Table, machine: str, blocks: int) -> None:
        """Fold rows that touch more blocks than there is room for."""
        if len(self._open):
            self._drain()
            self._fold_piece(rows, machine)
        elif len(rows) == 1:  # its stencil alone is larger than all open blocks
            self._open = OpenBlocks(blocks)
            self._fold_piece(rows, machine)
        else:
            rows, half = rows[np.lexsort((rows["x_m"], rows["y_m"]))], len(rows) // 2
            self._fold_piece(rows[:half], machine)
            self._fold_piece(rows[half:], machine)

    def _drain(self) -> None:
        """Pack all open blocks."""
        for code, page in self._open.drain():
            bucket, x, y = split_code(code)
            self._timeline((x, y)).add(bucket, page)
            self._touched.add((x, y))

    def _timeline(self, block: Block) -> Timeline:
        timeline = self._timelines.get(block)
        if timeline is None:
            timeline = self._timelines[block] = Timeline(self._tiers)
        return timeline


def warm_up(config: FoldConfig) -> None:
    """Compile the kernels, or read them from their cache, before a query or a batch waits for them."""
    row = np.zeros(1, SAMPLE_DTYPE)
    grid = Grid(1.0, config)
    for stamp_ns in (1, 1, 2 * config.bucket_ns * (config.keep_buckets + 1)):
        row["stamp_ns"], row["distance_m"] = stamp_ns, 1.0
        grid.fold(row, "")
        grid.state()


def chunks(blocks: list[Block]) -> Iterator[list[Block]]:
    """Cut a list of blocks into pieces that are read at once."""
    for first in range(0, len(blocks), READ_BLOCKS):
        yield blocks[first : first + READ_BLOCKS]
