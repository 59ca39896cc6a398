"""The two tasks of a fold: parts to samples and evidence; all evidence of a tile, merged.

    TOKEN.parquet                samples of one part for the new archive
    evidence-TOKEN.checkpoint    evidence of one task's parts, by block
    tile-TOKEN.checkpoint        evidence of one tile, of all tasks

They are in folder `work` of OUT.part. A token hashes everything the file depends on, so existing files are reused.
"""

from __future__ import annotations

import hashlib
import socket
from collections.abc import Generator, Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import mapserver
import protocol
from mapserver.calibration.correction import SampleCorrections
from mapserver.evidence.fold_config import FoldConfig
from mapserver.evidence.grid import Grid
from mapserver.evidence.grid_state import GridState
from mapserver.evidence.pages import Record
from mapserver.journal.archive import READABLE, ArchiveWriter
from mapserver.journal.archive_file import seal
from mapserver.journal.history import PIECE, fold_samples
from mapserver.journal.rows import JournalRows, Selection, SpoolKey
from mapserver.past.checkpoint_file import Checkpoint, DamagedError, Header, write_checkpoint
from protocol.arrays import Ints, Table
from protocol.errors import StoreError
from protocol.files import whole_file
from protocol.site.geometry import BLOCK_CELLS, CellWindow
from protocol.site.site_config import SiteConfig
from sitegrid.refold.parts import Interval, Part, chosen

TILES = 64  # upper bound of merging processes; at least 4, as no tile crosses an axis
LEAST_TILE = 8  # blocks: 128 cells
MERGED_AT_ONCE = 8  # tasks whose evidence waits for the next sum
STORE_FILE = "store-id"  # beside them: the store they belong to


@dataclass(frozen=True)
class Fold:
    """Common to all tasks of a fold. code: digest of the planning program; store: new store's id."""

    folder: Path
    store: str
    site: SiteConfig
    config: FoldConfig
    selection: Selection
    corrections: SampleCorrections
    code: str

    def check(self) -> None:
        """StoreError unless this process runs the same program and sees the fold's folder."""
        here = socket.gethostname()
        if (code := code_digest()) != self.code:
            problem = (
                f"a worker on {here} has another version of sitegrid ({code}, not {self.code}); install the same one"
            )
            raise StoreError("--engine", problem)
        with suppress(OSError):
            if (self.folder / STORE_FILE).read_text(encoding="utf-8") == self.store:
                return
        problem = f"a worker on {here} does not see this folder; all workers have to share the one where --out is"
        raise StoreError(self.folder, problem)

    def token(self, *words: object) -> str:
        """Hex digits that identify the fold and these words."""
        chosen = (self.selection.from_ns, self.selection.to_ns, sorted(self.selection.without))
        facts = (self.code, self.store, self.site, self.config, chosen, self.corrections.digest())
        return hashlib.sha256(repr((facts, words)).encode()).hexdigest()[:24]


@dataclass(frozen=True)
class PartWork:
    """A part to fold. row: first kept row in the new store, of `rows`. taken: samples of earlier parts."""

    part: Part
    identity: str
    first_ns: int
    row: int
    rows: int
    samples: int
    taken: tuple[tuple[SpoolKey, tuple[Interval, ...]], ...]


@dataclass(frozen=True)
class FoldTask:
    """Parts, and threads to fold them."""

    fold: Fold
    parts: tuple[PartWork, ...]
    threads: int

    @property
    def evidence(self) -> Path:
        """Their evidence file."""
        return (
            self.fold.folder
            / f"evidence-{self.fold.token(*((p.identity, p.row, p.taken) for p in self.parts))}.checkpoint"
        )

    def samples(self, part: PartWork) -> Path:
        """One part's sample file."""
        return self.fold.folder / f"{self.fold.token(part.identity, part.row, part.taken)}.parquet"


@dataclass(frozen=True)
class TileTask:
    """A tile in blocks: first column, row, edge; all evidence files."""

    fold: Fold
    column: int
    row: int
    edge: int
    evidence: tuple[Path, ...]

    @property
    def path(self) -> Path:
        """Its evidence file."""
        names = (path.name for path in self.evidence)
        return self.fold.folder / f"tile-{self.fold.token(self.column, self.row, self.edge, *names)}.checkpoint"


def fold_parts(task: FoldTask) -> None:
    """Fold parts and write their samples, unless done. StoreError if a part is damaged."""
    task.fold.check()
    if all(path.exists() for path in (task.evidence, *map(task.samples, task.parts))):
        return
    grid = Grid(task.fold.site.cell_m, task.fold.config)
    fold_samples(grid, _samples(task), threads=task.threads)
    _write(task.evidence, task.fold.store, grid.state())


def merge_tile(task: TileTask) -> None:
    """Merge all tasks' evidence of a tile, unless done."""
    task.fold.check()
    if task.path.exists():
        return
    edge = task.edge * BLOCK_CELLS
    window = CellWindow(task.column * BLOCK_CELLS, task.row * BLOCK_CELLS, edge, edge)
    grid = Grid(task.fold.site.cell_m, task.fold.config)
    for number, path in enumerate(task.evidence, 1):
        with opened(path) as checkpoint:
            blocks = tuple(checkpoint.blocks(checkpoint.numbers_in(window)))
        grid.merge(Grid.from_state(grid.cell_m, grid.config, GridState(blocks, 0, 0, 0, 0)))
        if number % MERGED_AT_ONCE == 0:
            grid.state()  # sums pending evidence
    _write(task.path, task.fold.store, grid.state())


def tiles(fold: Fold, evidence: Sequence[Path]) -> Iterator[TileTask]:
    """At most TILES tiles over all evidence; edges depend on its extent only."""
    x, y = _places(evidence)
    edge = LEAST_TILE
    while len(corners := {(a // edge, b // edge) for a, b in set(zip(x.tolist(), y.tolist(), strict=True))}) > TILES:
        edge *= 2
    for column, row in sorted(corners):
        yield TileTask(fold, column * edge, row * edge, edge, tuple(evidence))


def merged_state(evidence: Sequence[Path], parts: Sequence[Path]) -> GridState:
    """State of the whole grid. evidence: for the totals. parts: for the blocks."""
    headers = []
    for path in evidence:
        with opened(path) as checkpoint:
            headers.append(checkpoint.header)
    blocks: list[tuple[int, int, Record]] = []
    for path in parts:
        with opened(path) as checkpoint:
            blocks += checkpoint.blocks(checkpoint.numbers_in(None))
    return GridState(
        tuple(sorted(blocks, key=lambda block: block[:2])),
        sum(header.folded for header in headers),
        sum(header.skipped for header in headers),
        max(header.newest_ns for header in headers),
        min((header.oldest_ns for header in headers if header.oldest_ns), default=0),
    )


def opened(path: Path) -> Checkpoint:
    """Open an evidence file; if damaged, delete it and raise StoreError."""
    try:
        return Checkpoint(path)
    except DamagedError:
        path.unlink(missing_ok=True)
        raise StoreError(path, "was damaged, and is removed; run the same command again: it goes on") from None
    except OSError as error:
        raise StoreError(path, f"cannot be read: {error.strerror}") from None


@cache
def code_digest() -> str:
    """Digest of the code that determines evidence; a version is too coarse for bit equality."""
    digest = hashlib.sha256()
    for package in (protocol, mapserver):
        root = Path(str(package.__file__)).parent
        for path in sorted(root.rglob("*.py")):
            digest.update(f"{path.relative_to(root)}\n".encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def _samples(task: FoldTask) -> Generator[tuple[Table, NDArray[np.uint64]], None, None]:
    """Corrected samples of all parts in pieces; writes the parts' files on the way."""
    selection = Selection(corrections=task.fold.corrections)
    for part in task.parts:
        try:
            with ExitStack() as opening:
                file = opening.enter_context(whole_file(task.samples(part), READABLE))
                with ArchiveWriter(file, task.fold.store, task.fold.site) as writer:
                    for rows in _kept(task.fold, part):
                        writer.add(rows)
                        samples, names = rows.selected(selection)
                        for first in range(0, len(samples), PIECE):
                            yield samples[first : first + PIECE], names[first : first + PIECE]
                seal(file)
        except OSError as error:
            raise StoreError(task.fold.folder, f"cannot be written: {error.strerror or error}") from None


def _kept(fold: Fold, part: PartWork) -> Iterator[JournalRows]:
    """A part's rows, renumbered."""
    number = part.row
    for rows in part.part.read():
        kept, _ = chosen(rows, fold.selection, dict(part.taken))
        if kept.any():
            cut = rows.cut(kept, number)
            number += len(cut)
            yield cut
    if number != part.row + part.rows:
        raise StoreError(part.part, "has changed while it was folded; fold again")


def _write(path: Path, store: str, state: GridState) -> None:
    try:
        write_checkpoint(path, Header(0, 0, {"store": store}), state)
    except OSError as error:
        raise StoreError(path.parent, f"cannot be written: {error.strerror or error}") from None


def _places(evidence: Sequence[Path]) -> tuple[Ints, Ints]:
    """Columns and rows of all blocks, with repetitions."""
    xs, ys = [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    for path in evidence:
        with opened(path) as checkpoint:
            xs.append(checkpoint.index["x"].astype(np.int64))
            ys.append(checkpoint.index["y"].astype(np.int64))
    return np.concatenate(xs), np.concatenate(ys)
