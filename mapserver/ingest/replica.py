"""A store's map in a process that reads its journal: grid, facts and events.

No clock, thread or file. For equal rows and facts the grid equals the server's, bit for bit.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence

import numpy as np

from mapserver.change import change_log
from mapserver.config import ServerConfig
from mapserver.evidence.grid import Grid
from mapserver.ingest.decisions import Decisions
from mapserver.journal.facts import Facts
from mapserver.journal.rows import Event, JournalRows, Selection
from mapserver.journal.tail import Tail
from protocol.queries.answers import GroundChange, MapVersion
from protocol.site.site_config import SiteConfig


class Replica:
    """See `MapState`. tail: position in the journal. merged: last row in the grid. changes: by number."""

    def __init__(self, site: SiteConfig, config: ServerConfig, tail: Tail) -> None:
        self.site, self.config, self.tail = site, config, tail
        self.grid, self.facts = Grid(site.cell_m, config.fold), Facts()
        self.merged = 0
        self.changes: dict[int, GroundChange] = {}
        self._decisions = Decisions(site.cell_m)
        self._newest_ns: dict[str, int] = {}

    @property
    def version(self) -> MapVersion:
        """The map's version."""
        return MapVersion(self.tail.store, self.merged, self.facts.number)

    @property
    def newest_ns(self) -> int:
        """The site's now: newest stamp of machines in the map, 0 for none."""
        shown = (stamp for name, stamp in self._newest_ns.items() if name not in self.facts.excluded)
        return max(shown, default=0)

    def machines(self) -> Collection[str]:
        """Names of machines that have sent samples."""
        return self._newest_ns.keys()

    @property
    def wanted(self) -> Facts:
        """Facts of all decisions; the grid must be rebuilt if its facts differ."""
        return self._decisions.facts

    def hear(self, events: Sequence[Event], where: str) -> None:
        """Apply further events. StoreError for another program's decision."""
        self._decisions.hear(events, where)
        for event in events:
            if event.kind == change_log.KIND:
                change = change_log.change_of(event.body)
                self.changes[change.id] = change
        self.tail.heard(events)
        if self.wanted == self.facts:
            self.grid.renew(self.facts.repairs.differing(self.wanted.repairs))
            self.facts = self.wanted  # with a higher number, and other repairs

    def fold(self, rows: JournalRows) -> None:
        """Fold the next rows."""
        self.grid.fold_all(*rows.without(self.facts.excluded).selected(Selection.by(self.facts)))
        stamps, ends = rows.samples["stamp_ns"], np.cumsum(rows.lengths)
        newest_ns = np.maximum.reduceat(stamps, ends - rows.lengths)
        names = (rows.machines[machine] for machine in rows.machine.tolist())
        self.reach(zip(names, newest_ns.tolist(), strict=True))
        self.merged = int(rows.numbers[-1])

    def reach(self, newest_ns: Iterable[tuple[str, int]]) -> None:
        """Note stamps of machines, excluded or not."""
        for name, stamp_ns in newest_ns:
            self._newest_ns[name] = max(self._newest_ns.get(name, 0), stamp_ns)

    def adopt(self, grid: Grid, row: int, facts: Facts) -> None:
        """Continue with a grid of these facts and all rows up to this one."""
        self.grid, self.merged, self.facts = grid, row, facts
        if self.wanted == facts:
            self.facts = self.wanted
