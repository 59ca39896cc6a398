"""The grid in memory: driven blocks of 16 x 16 cells, their pages by time. Owned by one thread."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager

import numpy as np
from numpy.typing import NDArray

from mapserver.evidence import cells as ev
from mapserver.evidence.fold import Scratch, fold
from mapserver.evidence.fold_config import FoldConfig, name_hash
from mapserver.evidence.grid_state import GridCounts, GridState
from mapserver.evidence.pages import Record, is_sound
from mapserver.evidence.sample_kernels import count_foldable, extent
from mapserver.evidence.settling import Space, Tiers
from mapserver.evidence.timeline import PATIENCE, Block, TimedPages, Timeline, evidence, settle_all, timed
from mapserver.evidence.workers import ALONE, Workers
from protocol.arrays import AnyArray, Table
from protocol.machine.samples import RAW_SAMPLE, SAMPLE_DTYPE
from protocol.site.geometry import BLOCK_CELLS, CellWindow

# Samples folded at once; more make fewer pages. Live, folds must be short (8 ms), because the map is read every second;
# refolding, only the total counts. Per worker.
LIVE_ROWS, REFOLD_ROWS = 8192, 131_072
PIECE = 4096  # samples that stay far below COUNT_MAX in total
READ_BLOCKS = 32  # blocks summed at once: 7 MB, within the processor's cache


class Grid:
    """Evidence of one site. newest_ns, oldest_ns: of all samples, 0 for none."""

    def __init__(self, cell_m: float, config: FoldConfig, waiting_rows: int = LIVE_ROWS) -> None:
        """waiting_rows: samples folded at once; no influence on the result."""
        self.cell_m = cell_m
        self.config = config
        self.newest_ns = self.oldest_ns = 0
        self._folded = self._skipped = self._cells = 0
        self._blocks: tuple[int, int, int, int] | None = None  # bounds of all blocks: west, south, east, north
        self._tiers = Tiers.from_config(config)
        self._timelines: dict[Block, Timeline] = {}
        self._touched: set[Block] = set()
        self._turn = 0  # number of folds
        self._workers, self._scratch, self._spaces = ALONE, [Scratch()], [Space()]
        self._rows: AnyArray = np.empty(waiting_rows, RAW_SAMPLE)
        self._names = np.empty(waiting_rows, np.uint64)
        self._waiting, self._weight = 0, 0

    @property
    def folded(self) -> int:
        """Samples that voted."""
        self._drain()
        return self._folded

    @property
    def skipped(self) -> int:
        """Samples too uncertain of position to vote."""
        self._drain()
        return self._skipped

    def fold(self, rows: Table, machine: str) -> None:
        """Fold samples of one machine; commutative, not idempotent (the journal ensures exactly-once)."""
        self.fold_all(rows, np.full(len(rows), name_hash(machine), np.uint64))

    def fold_all(self, rows: Table, names: NDArray[np.uint64]) -> None:
        """Fold samples of several machines; names (n,): hashes of their names."""
        for first in range(0, len(rows), PIECE):
            self._take(np.ascontiguousarray(rows[first : first + PIECE]), names[first : first + PIECE])

    def merge(self, other: Grid) -> None:
        """Add another grid: bit for bit the fold of both.

        Commutative and associative, not idempotent. ValueError for another cell size or configuration.
        """
        if (self.cell_m, self.config) != (other.cell_m, other.config):
            raise ValueError(f"folded otherwise: {other.cell_m} m, {other.config}; {self.cell_m} m, {self.config}")
        self._drain()
        other._drain()
        self._turn += 1
        self._extend(other._timelines)
        for block, timeline in other._timelines.items():
            self._cells += sum(self._add(block, record) for record in timeline.records)
        self._folded += other._folded
        self._skipped += other._skipped
        self._widen(other.oldest_ns, other.newest_ns)

    @contextmanager
    def bulk(self, workers: Workers = ALONE) -> Iterator[None]:
        """Fold a long history by these workers, and settle it.

        Only `fold` may be called meanwhile, by one thread. Workers do not change the result; an error makes the grid
        unusable.
        """
        self._engage(workers, REFOLD_ROWS * workers.count)
        yield
        self._drain()
        workers.each(self._settle)
        self._engage(ALONE, LIVE_ROWS)

    def blocks_in(self, window: CellWindow) -> list[Block]:
        """Blocks (column, row) with evidence in a window."""
        self._drain()
        first_x, last_x = window.column // BLOCK_CELLS, (window.column + window.columns - 1) // BLOCK_CELLS
        first_y, last_y = window.row // BLOCK_CELLS, (window.row + window.rows - 1) // BLOCK_CELLS
        if (last_x - first_x + 1) * (last_y - first_y + 1) > len(self._timelines):
            return sorted((x, y) for x, y in self._timelines if first_x <= x <= last_x and first_y <= y <= last_y)
        inside = ((x, y) for x in range(first_x, last_x + 1) for y in range(first_y, last_y + 1))
        return [block for block in inside if block in self._timelines]

    def size(self, blocks: Iterable[Block]) -> int:
        """Bytes of the evidence in blocks."""
        self._drain()
        lines = (self._timelines.get(block) for block in blocks)
        return sum(len(record) for line in lines if line for record in line.records)

    def pages(self, blocks: Iterable[Block]) -> list[TimedPages]:
        """Pages of each block by time; empty without evidence."""
        self._drain()
        return timed([self._timelines.get(block) for block in blocks], self._tiers, self._spaces[0])

    def touch_all(self) -> None:
        """Mark all blocks as touched."""
        self._drain()
        self._touched |= set(self._timelines)

    def take_touched(self, most: int) -> list[Block]:
        """Take some blocks folded since they were last taken."""
        self._drain()
        return [self._touched.pop() for _ in range(min(most, len(self._touched)))]

    def renew(self, blocks: Iterable[Block]) -> None:
        """Have readers derive blocks again, as after a fold: their evidence is read otherwise."""
        self._drain()
        self._turn += 1
        for block in blocks:
            if timeline := self._timelines.get(block):
                timeline.turn = self._turn

    def folded_since(self, turn: int) -> tuple[list[Block], int]:
        """Blocks folded or renewed after a turn (-1: all), and the present turn."""
        self._drain()
        return [block for block, timeline in self._timelines.items() if timeline.turn > turn], self._turn

    def evidence(self, blocks: Iterable[Block]) -> ev.Evidence:
        """All evidence of blocks, valid or not."""
        return evidence(self.pages(blocks))

    def last_turns(self, blocks: Iterable[Block]) -> list[int]:
        """The last turn in which each block was folded or renewed, -1 for none."""
        self._drain()
        timelines = (self._timelines.get(block) for block in blocks)
        return [timeline.turn if timeline else -1 for timeline in timelines]

    def bounds(self) -> tuple[int, int, int, int] | None:
        """First column, first row, end column, end row of all evidence."""
        self._drain()
        return self.counts().bounds

    def known_cells(self) -> int:
        """Number of cells with evidence."""
        self._drain()
        return self._cells

    def counts(self) -> GridCounts:
        """Counts without folding what waits."""
        waiting = self._rows[: self._waiting].view(SAMPLE_DTYPE)
        voting, n = count_foldable(waiting, self.config.std_cap_m**2), BLOCK_CELLS
        bounds = None
        if self._blocks:
            west, south, east, north = self._blocks
            bounds = west * n, south * n, (east + 1) * n, (north + 1) * n
        return GridCounts(self._folded + voting, self._skipped + len(waiting) - voting, self._cells, bounds)

    def state(self) -> GridState:
        """The whole content, sorted, so that equal grids have equal states."""
        self._drain()
        settle_all(self._timelines.values(), self._tiers, self._spaces[0])
        blocks = ((x, y, self._timelines[x, y].records[0]) for x, y in sorted(self._timelines))
        return GridState(tuple(blocks), self._folded, self._skipped, self.newest_ns, self.oldest_ns)

    @classmethod
    def from_state(cls, cell_m: float, config: FoldConfig, state: GridState) -> Grid:
        """Inverse of `state`."""
        grid = cls(cell_m, config)
        grid._extend((x, y) for x, y, _ in state.blocks)
        grid._timelines = {(x, y): Timeline([record]) for x, y, record in state.blocks}
        grid._cells = sum(timeline.known.bit_count() for timeline in grid._timelines.values())
        grid._folded, grid._skipped = state.folded, state.skipped
        grid.newest_ns, grid.oldest_ns = state.newest_ns, state.oldest_ns
        return grid

    def _widen(self, oldest_ns: int, newest_ns: int) -> None:
        """0, 0 for no samples."""
        self.newest_ns = max(self.newest_ns, newest_ns)
        self.oldest_ns = min(self.oldest_ns or oldest_ns, oldest_ns or self.oldest_ns)

    def _take(self, rows: Table, names: NDArray[np.uint64]) -> None:
        """Queue rows; fold before their weight exceeds a count."""
        oldest_ns, newest_ns, driven_m = extent(rows)
        self._widen(oldest_ns, newest_ns)
        weight = int(driven_m * ev.WEIGHT_UNITS_PER_M) + len(rows)
        if self._weight + weight > ev.COUNT_MAX:
            self._drain()
        self._weight += weight
        while len(rows):
            part = rows[: len(self._rows) - self._waiting]
            end = self._waiting + len(part)
            self._rows[self._waiting : end] = part.view(RAW_SAMPLE)
            self._names[self._waiting : end] = names[: len(part)]
            self._waiting, rows, names = end, rows[len(part) :], names[len(part) :]
            if end == len(self._rows):
                self._drain()

    def _drain(self) -> None:
        """Fold the queue."""
        if not self._waiting:
            return
        rows, names = self._rows[: self._waiting].view(SAMPLE_DTYPE), self._names[: self._waiting]
        count = self._workers.count
        records: list[list[tuple[Block, Record]]] = [[] for _ in range(count)]  # by worker of the block
        cells = [0] * count

        def fold_share(worker: int) -> None:
            share = slice(worker * len(rows) // count, (worker + 1) * len(rows) // count)
            for block, record in fold(rows[share], names[share], self.cell_m, self.config, self._scratch[worker]):
                records[_worker_of(block, count)].append((block, record))

        def add_share(worker: int) -> None:
            """Add to own blocks only, so no timeline has two writers."""
            cells[worker] = sum(self._add(block, record) for block, record in records[worker])
            own = (self._timelines[block] for block in {block for block, _ in records[worker]})
            settle_all(own, self._tiers, self._spaces[worker], PATIENCE)

        self._turn += 1
        self._workers.each(fold_share)
        self._workers.each(add_share)
        self._cells += sum(cells)
        self._extend({block for share in records for block, _ in share})
        voting = count_foldable(rows, self.config.std_cap_m**2)
        self._folded += voting
        self._skipped += len(rows) - voting
        self._waiting, self._weight = 0, 0

    def _add(self, block: Block, record: Record) -> int:
        """Returns the number of new cells."""
        timeline = self._timelines.get(block)
        if timeline is None:
            timeline = self._timelines[block] = Timeline()
        timeline.turn = self._turn
        self._touched.add(block)
        return timeline.add(record)

    def _extend(self, blocks: Iterable[Block]) -> None:
        """Extend the bounds."""
        for x, y in blocks:
            west, south, east, north = self._blocks or (x, y, x, y)
            self._blocks = min(west, x), min(south, y), max(east, x), max(north, y)

    def _settle(self, worker: int) -> None:
        own = [line for block, line in self._timelines.items() if _worker_of(block, self._workers.count) == worker]
        settle_all(own, self._tiers, self._spaces[worker])

    def _engage(self, workers: Workers, waiting_rows: int) -> None:
        """Continue with other workers, each with its own memory."""
        self._drain()
        self._workers = workers
        self._rows, self._names = np.empty(waiting_rows, RAW_SAMPLE), np.empty(waiting_rows, np.uint64)
        self._scratch = [Scratch() for _ in range(workers.count)]
        self._spaces = [Space() for _ in range(workers.count)]


def _worker_of(block: Block, count: int) -> int:
    """Neighbouring blocks, which the same machines drive over, go to different workers."""
    return (block[0] + block[1]) % count


def warm_up(config: FoldConfig) -> None:
    """Compile the kernels, or load them, before a query or batch waits for them."""
    row = np.zeros(1, SAMPLE_DTYPE)
    grid = Grid(1.0, config)
    for stamp_ns in (1, 1, 2 * config.bucket_ns * (config.keep_buckets + 1)):
        row["stamp_ns"], row["distance_m"] = stamp_ns, 1.0
        grid.fold(row, "")
        grid.state()
    Grid(1.0, config).merge(grid)
    assert all(is_sound(record) for *_, record in grid.state().blocks)
    for pages in grid.pages([(0, 0)]):
        list(pages)


def chunks(blocks: list[Block]) -> Iterator[list[Block]]:
    """Cut blocks into pieces read at once."""
    for first in range(0, len(blocks), READ_BLOCKS):
        yield blocks[first : first + READ_BLOCKS]
