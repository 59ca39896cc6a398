"""A watched map ends with the region's bits, whatever arrived or failed in between."""

from contextlib import closing, suppress
from itertools import count
from threading import Event

import numpy as np
import pytest

from mapserver.ingest.writer import Writer
from protocol.errors import LinkError, QueryError, Refusal
from protocol.queries.map_tiles import TilesAnswer, TilesQuery
from protocol.queries.requests import PieceQuery, RegionQuery
from protocol.site.geometry import Bounds
from sitegrid.watch import watch
from sitegrid.whole_answers import joined
from tests.unit.mapserver.data import incoming, open_writer, random_samples, send
from tests.unit.mapserver.query.fake_upkeep import AnswersOf, answers_of

BASE = random_samples(9000, seed=0)
LAYERS = ("resistance", "resistance_std", "grade_filled", "resistance_filled", "visits", "weight")
BOX = Bounds(-70.0, -40.0, 33.0, 64.0)


class EnoughError(Exception):
    """Nothing more is asked."""


def until_enough(regions):
    with suppress(EnoughError):
        yield from regions


class Site:
    """A map with samples between looks, late ones too, and occasional silence."""

    def __init__(self, writer: Writer, rounds: int) -> None:
        self.answers: AnswersOf = answers_of(writer)
        self.writer, self.rounds, self.draw = writer, rounds, np.random.default_rng(rounds)
        self.looks, self.sent = count(1), 0
        send(writer, [incoming(BASE, machine="loader")])

    def tiles(self, query: TilesQuery) -> TilesAnswer:
        look = next(self.looks)
        if look >= self.rounds:
            raise EnoughError
        if self.draw.random() < 0.4:
            rows = self.draw.choice(BASE, 1) if look > self.rounds / 2 else random_samples(3, seed=look)
            if look > self.rounds / 2:  # below the tiles' 8-bit steps
                rows["distance_m"] = 0.05
            send(self.writer, [incoming(rows, machine="loader", spool_id=look)])
            self.sent += 1
        if self.draw.random() < 0.3:
            raise LinkError("tcp/x", "no map server answers")
        first = answer = self.answers.tiles(query)
        tiles = [*answer.tiles]
        while answer.next_place:
            answer = self.answers.tiles(TilesQuery(query.since, answer.next_place))
            tiles += answer.tiles
        return TilesAnswer(first.version, first.stamp_ns, first.cell_m, first.whole, tuple(tiles))

    def region(self, area: Bounds):
        return joined(self._pieces(RegionQuery(area, LAYERS)))

    def _pieces(self, query: RegionQuery):
        yield (first := self.answers.region(query))
        for number in range(1, first.piece.count if first.piece else 0):
            yield self.answers.piece(PieceQuery(first.piece.cursor, number))


@pytest.mark.parametrize("bounds", [None, BOX])
def test_what_was_watched_ends_with_the_bits_of_the_region(tmp_path, bounds):
    with closing(open_writer(tmp_path)) as writer:
        site = Site(writer, 60)
        area = bounds or Bounds(-192.0, -192.0, 192.0, 192.0)
        size = int(area.north_m - area.south_m), int(area.east_m - area.west_m)
        seen = {name: np.full(size, np.nan, np.float32) for name in LAYERS}
        regions = watch(site.tiles, site.region, bounds, 0.0, Event())
        for region in until_enough(regions):
            row, column = int(region.bounds.south_m - area.south_m), int(region.bounds.west_m - area.west_m)
            for name, values in region.layers.items():
                seen[name][row : row + values.shape[0], column : column + values.shape[1]] = values
        assert site.sent > 10
        whole = site.region(area)
        for name, values in seen.items():
            assert values.tobytes() == whole[name].tobytes(), name


def test_a_question_that_is_refused_ends_the_watch():
    def refused(_: TilesQuery) -> TilesAnswer:
        raise QueryError(Refusal.UNKNOWN_LAYER, "layer `x` is not known")

    with pytest.raises(QueryError, match="layer `x`"):
        next(watch(refused, refused, None, 0.0, Event()))
