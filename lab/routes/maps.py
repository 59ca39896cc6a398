"""Maps for routes: a server's from samples, and the truth in its form."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence, Set
from typing import TypeVar

import numpy as np

from mapserver.config import ServerConfig
from mapserver.evidence.grid import Grid
from mapserver.journal.facts import NO_FACTS
from mapserver.query.block_layers import BlockLayers, Look
from mapserver.query.routes import Routes
from mapserver.routes.ground import Squares
from mapserver.routes.route import LAYERS
from protocol.arrays import Floats32, Table
from protocol.queries.answers import MapVersion
from protocol.site.site_config import SiteConfig
from sim.truth import TruthMap

T = TypeVar("T")
SITE = SiteConfig("judged", 48.0, 9.0)


class KnownMap:
    """A server's map from samples; the parts of a source that routes need."""

    def __init__(self, samples: Mapping[str, Table], site: SiteConfig = SITE) -> None:
        self.site, self.config = site, ServerConfig()
        self.grid = Grid(site.cell_m, self.config.fold)
        for name, table in samples.items():
            self.grid.fold(table, name)
        self.version, self.facts = MapVersion("", 1, 0), NO_FACTS
        self.newest_ns = self.grid.newest_ns
        self._names = tuple(samples)

    def run(self, work: Callable[[KnownMap], T]) -> T:
        """See `MapSource`."""
        return work(self)

    def machines(self) -> Collection[str]:
        """See `MapState`."""
        return self._names

    def routes(self) -> Routes:
        """Route queries on the current map, without roads."""
        layers = BlockLayers(self.site.cell_m, self.config)

        def look(squares: Set[tuple[int, int]], names: Sequence[str], as_of_ns: int | None, **_: bool) -> Look:
            if as_of_ns is not None:
                raise NotImplementedError("nobody asks for the past here")
            return layers.look_squares(self, squares, names)

        return Routes(self, layers, look)  # type: ignore[arg-type]


def true_squares(truth: TruthMap) -> Squares:
    """A true map for routes: known everywhere, certain."""
    rows, columns = truth.c_rr.shape
    edge = max(rows, columns)

    def square(values: Floats32 | float) -> Floats32:
        out = np.full((edge, edge), np.nan, np.float32)
        out[:rows, :columns] = values
        return out

    layers = dict.fromkeys(LAYERS, square(0.0)) | {
        "resistance_filled": square(truth.c_rr),
        "grade_east_filled": square(truth.grade_east),
        "grade_north_filled": square(truth.grade_north),
        "visits": square(1.0),
        "confidence": square(1.0),
    }
    if (truth.west_m, truth.south_m) != (0.0, 0.0):
        raise ValueError("a true map begins at the origin")
    return Squares.stacked(truth.cell_m, edge, {(0, 0): layers})
