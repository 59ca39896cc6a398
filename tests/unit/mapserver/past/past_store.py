"""A store of past samples without a server: journal, archive, checkpoints."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from mapserver.evidence.fold_config import FoldConfig
from mapserver.evidence.grid import Grid
from mapserver.journal.archive import FOLDER, archive
from mapserver.journal.facts import Facts
from mapserver.journal.sqlite.journal import SqliteJournal
from mapserver.journal.sqlite.reader import SqliteReader
from mapserver.past.making import make
from mapserver.past.past import StorePast
from protocol.arrays import Table
from protocol.units import HOUR_NS
from tests.unit.mapserver.data import NOW_NS, SITE, batch, put

FOLD = FoldConfig()
S = 10**9


class PastStore:
    """A batch per journal row, received an hour apart."""

    def __init__(self, folder: Path, cell_m: float = 1.0, config: FoldConfig = FOLD) -> None:
        self.folder = folder
        self.journal = SqliteJournal(folder / "journal.db", SITE.name, SITE.frame)
        self.reader = SqliteReader(self.journal.path)
        self.past = StorePast.of_store(folder, cell_m, config)
        self.sent: list[tuple[str, Table]] = []

    def add(self, rows: Table, machine: str = "a") -> None:
        first_seq = 1 + sum(len(table) for name, table in self.sent if name == machine)
        put(self.journal, batch(rows, first_seq, machine), NOW_NS + self.journal.last_row * HOUR_NS)
        self.sent.append((machine, rows))

    def archive(self, rows: int) -> None:
        list(archive(self.folder / FOLDER, self.reader, SITE, NOW_NS + rows * HOUR_NS, self.journal.forget))

    def make(self, closed_ns: int, without: Iterable[str] = ()) -> int:
        """Returns the number of steps."""
        return sum(1 for _ in make(self.past, self.reader, closed_ns, Facts(frozenset(without))))

    def as_of(self, to_ns: int, without: Iterable[str] = (), **more: object) -> Grid:
        return self.past.grid_as_of(self.reader, to_ns, facts=Facts(frozenset(without)), **more)

    def folded(self, to_ns: int, without: Iterable[str] = (), from_ns: int = 0) -> Grid:
        """The map by definition: a fold of the samples from the start."""
        grid = Grid(self.past.cell_m, self.past.config)
        for machine, rows in self.sent:
            if machine not in without:
                stamps = rows["stamp_ns"]
                grid.fold(rows[np.logical_and(stamps >= from_ns, stamps <= to_ns)], machine)
        return grid

    def close(self) -> None:
        self.reader.close()
        self.journal.close()
