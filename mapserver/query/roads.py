"""Queries about roads answered: the tally of what drove follows the journal, roads and ledgers are made as asked."""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass

import numpy as np

from mapserver.evidence.fold_config import is_foldable
from mapserver.evidence.grid import Grid
from mapserver.journal.facts import NO_FACTS, Facts
from mapserver.journal.rows import Selection
from mapserver.query.source import MapSource, MapState
from mapserver.roads.ledger import Ledger, Ledgers
from mapserver.roads.loss import Losses, losses
from mapserver.roads.network import network
from mapserver.roads.passes import MINUTE_NS, PassTally
from mapserver.roads.repairs import Repair, repairs
from mapserver.roads.segments import Segments, segments
from mapserver.roads.skeleton import Pages, Skeletons
from mapserver.roads.tally import HOUR_NS, Tally, slot
from mapserver.roads.trend import trends
from mapserver.roads.worklist import litres, ranked, seconds
from protocol.arrays import Floats, Ints, Table
from protocol.errors import QueryError, Refusal, StoreError
from protocol.machine.readings import MAX_STAMP_NS
from protocol.queries import roads as answers
from protocol.queries.answers import MapVersion
from protocol.queries.requests import RoadQuery, SegmentsQuery, WorklistQuery
from protocol.site.geometry import Bounds, CellWindow

LOOK_BACK_NS = 30 * 24 * HOUR_NS  # before the site's now, of traffic: older journals are not read for it
MOST_SEGMENTS = 10_000  # of one answer: 250 km of roads, 3 MB
MOST_CHANGES = 1000  # of one worklist, the newest
LINE_POINTS = 5  # a point of a line is a metre from the next; one in so many is told


@dataclass(frozen=True)
class RoadMap:
    """Roads of one version of the map, and the tally that goes with it."""

    segments: Segments
    ledgers: Ledgers
    tally: Table
    changes: tuple[Repair, ...]
    version: MapVersion
    stamp_ns: int


class _Traffic:
    """What drove, in sums by hour and by pass."""

    def __init__(self) -> None:
        self.tally, self.passes = Tally(), PassTally()


class RoadMaps:
    """Makes road maps of one source. For any thread; one at a time works."""

    def __init__(self, source: MapSource) -> None:
        self._source, self._cell_m, self._config = source, source.site.cell_m, source.config
        self._lock = threading.Lock()
        self._skeletons = Skeletons(self._cell_m)
        self._made: RoadMap | None = None
        self._begin("", NO_FACTS)

    def _begin(self, store: str, facts: Facts) -> None:
        """Follow the journal anew."""
        self._traffic, self._followed, self._with = _Traffic(), 0, (store, facts)

    def segments(self, query: SegmentsQuery) -> answers.Segments:
        """Roads, and what drove on them."""
        roads = self._read(query)
        traffic, hours = _traffic(roads, query)
        rows = _Records(roads.segments, traffic, losses(traffic, roads.segments, 0.0), hours)
        chosen = _inside(roads.segments, query.bounds)
        if len(chosen) > MOST_SEGMENTS:
            problem = f"{len(chosen)} segments; at most {MOST_SEGMENTS} are answered: ask for less with `bounds`"
            raise QueryError(Refusal.TOO_LARGE, problem)
        version = (roads.version.store, roads.version.row, roads.version.fact, roads.stamp_ns)
        return answers.Segments(*version, hours, traffic.placed, tuple(rows(i) for i in chosen))

    def worklist(self, query: WorklistQuery) -> answers.Worklist:
        """Where work pays."""
        roads = self._read(query)
        traffic, hours = _traffic(roads, query)
        before, after = _levels(roads)
        lost = losses(traffic, roads.segments, query.target, after)
        saved_j = losses(traffic, roads.segments, query.target, before).work_j - lost.work_j
        rows, listed, inside = (
            _Records(roads.segments, traffic, lost, hours),
            ranked(lost),
            _inside(roads.segments, query.bounds),
        )
        work = np.stack([lost.work_j, lost.low_j, lost.high_j]) / max(hours, 1e-9)
        kg = lost.kg.mean(axis=1)
        out: list[answers.WorklistRow] = []
        for i, rank in zip(listed.order.tolist(), listed.rank.tolist(), strict=True):
            if i in inside and len(out) < query.limit:
                of_it = (work[:, i] / 3.6e6, litres(work[:, i], query.efficiency), seconds(work[:, i], kg[i]))
                out.append(answers.WorklistRow(rank, rows(i), *(tuple(values.tolist()) for values in of_it)))
        version = (roads.version.store, roads.version.row, roads.version.fact, roads.stamp_ns)
        total = float(work[0, sorted(inside)].sum() / 3.6e6)
        changes = [
            answers.RoadChange(
                roads.segments.ids[change.segment],
                rows(change.segment).line,
                change.minute * MINUTE_NS,
                (change.seen + 1) * MINUTE_NS,
                change.before,
                change.after,
                float(saved_j[change.segment] / max(hours, 1e-9) / 3.6e6),
            )
            for change in roads.changes
            if change.segment in inside
        ]
        shown = tuple(changes[:MOST_CHANGES])
        return answers.Worklist(*version, hours, query.target, total, tuple(out), shown)

    def _read(self, query: RoadQuery) -> RoadMap:
        _require_on_site(query.bounds, self._source.site.extent_m)
        try:
            if query.as_of_ns is not None:
                return self._as_of(query.as_of_ns)
            with self._lock:
                return self._now()
        except StoreError as error:
            raise QueryError(Refusal.STORE, str(error)) from None

    def _now(self) -> RoadMap:
        pages, version, facts, newest_ns = self._source.run(_all)
        if self._made and self._made.version == version:
            return self._made
        if self._with != (version.store, facts):
            self._begin(version.store, facts)
        self._follow(self._traffic, facts, newest_ns, self._followed, version.row)
        self._followed = version.row
        roads = segments(network(self._skeletons.skeleton(pages)))
        self._made = self._map(roads, self._traffic, version, newest_ns)
        return self._made

    def _as_of(self, as_of_ns: int) -> RoadMap:
        version, facts = self._source.run(lambda state: (state.version, state.facts))
        traffic = _Traffic()
        with self._source.location.reader() as reader:
            grid = self._source.past.grid_as_of(reader, as_of_ns, None, facts)
            self._follow(traffic, facts, as_of_ns, 0, version.row, as_of_ns)
        roads = segments(network(Skeletons(self._cell_m).skeleton(_pages(grid))))
        return self._map(roads, traffic, version, as_of_ns)

    def _follow(
        self, traffic: _Traffic, facts: Facts, newest_ns: int, after: int, until: int, to_ns: int = MAX_STAMP_NS
    ) -> None:
        """Take journal rows after < row <= until into the traffic, of samples up to `to_ns`."""
        if after >= until:
            return
        begin_ns = max(0, newest_ns - LOOK_BACK_NS) // HOUR_NS * HOUR_NS
        with self._source.location.reader() as reader:
            selection = Selection.by(facts, begin_ns, to_ns)
            for samples, names in self._source.past.samples(reader, selection, after, until):
                sure = is_foldable(samples, self._config.fold)
                traffic.tally.add(samples[sure], names[sure])
                traffic.passes.add(samples[sure], names[sure])

    def _map(self, roads: Segments, traffic: _Traffic, version: MapVersion, stamp_ns: int) -> RoadMap:
        """Put together; the look back is cut here, where it does not depend on when the journal was followed."""
        table, ledgers = traffic.tally.table(), Ledgers(roads)
        first = max(0, stamp_ns - LOOK_BACK_NS) // HOUR_NS
        table = table[slot(table["key"]) >= first]
        changes, _ = repairs(traffic.passes.passes(ledgers, first * HOUR_NS))
        newest_first = tuple(sorted(changes, key=lambda change: (-change.seen, change.segment)))
        return RoadMap(roads, ledgers, table, newest_first, version, stamp_ns)


def _all(state: MapState) -> tuple[Pages, MapVersion, Facts, int]:
    return _pages(state.grid), state.version, state.facts, state.newest_ns


def _pages(grid: Grid) -> Pages:
    bounds = grid.bounds()
    if bounds is None:
        return {}
    west, south, east, north = bounds
    blocks = grid.blocks_in(CellWindow(west, south, east - west, north - south))
    return dict(zip(blocks, grid.pages(blocks), strict=True))


def _require_on_site(bounds: Bounds | None, extent_m: float) -> None:
    if bounds is None:
        return
    inside = bounds.west_m < extent_m and bounds.east_m > -extent_m
    if not (inside and bounds.south_m < extent_m and bounds.north_m > -extent_m):
        problem = f"`bounds` lie off the site, which reaches {extent_m:g} m from its origin"
        raise QueryError(Refusal.OUT_OF_RANGE, problem)


def _traffic(roads: RoadMap, query: RoadQuery) -> tuple[Ledger, float]:
    """The ledger of a query's hours, and how many hours with driving these are, the running one in part."""
    from_ns, to_ns = query.from_ns or 0, query.to_ns or 2**62
    traffic = roads.ledgers.ledger(roads.tally, HOUR_NS, from_ns // HOUR_NS * HOUR_NS, to_ns)
    slots = np.unique(traffic.rows["slot"])
    ends = np.minimum((slots + 1) * HOUR_NS, max(roads.stamp_ns, 1))
    hours = float(np.maximum(ends - slots * HOUR_NS, 0).sum() / HOUR_NS)
    return traffic, hours


def _levels(roads: RoadMap) -> tuple[Floats, Floats]:
    """c_rr of segments (k,) before and after their last change, NaN where there was none."""
    before, after = np.full((2, len(roads.segments.ids)), np.nan)
    for change in reversed(roads.changes):  # the newest last
        before[change.segment], after[change.segment] = change.before, change.after
    return before, after


def _inside(roads: Segments, bounds: Bounds | None) -> set[int]:
    """Segments whose middle lies in a rectangle."""
    if bounds is None:
        return set(range(len(roads.ids)))
    middle = roads.points[(roads.ends[:-1] + roads.ends[1:]) // 2] if len(roads.ids) else roads.points
    x, y = middle.T
    within = (x >= bounds.west_m) & (x < bounds.east_m) & (y >= bounds.south_m) & (y < bounds.north_m)
    return set(np.flatnonzero(within).tolist())


class _Records:
    """Records of segments, by number."""

    def __init__(self, roads: Segments, traffic: Ledger, lost: Losses, hours: float) -> None:
        self._segments, self._lost, self._hours = roads, lost, max(hours, 1e-9)
        self._trends = trends(traffic)
        machines = traffic.totals()["machines"]
        self._machines: Ints = np.bitwise_count(machines[:, 0] | machines[:, 1]).astype(np.int64)

    def __call__(self, i: int) -> answers.RoadSegment:
        lost, line = self._lost, self._segments.line(i)
        passes = lost.passes[i] / self._hours
        some = np.concatenate([line[:-1:LINE_POINTS], line[-1:]]).round(2)
        return answers.RoadSegment(
            id=self._segments.ids[i],
            line=tuple(tuple(point) for point in some.tolist()),
            length_m=float(self._segments.length_m[i]),
            resistance=_known(lost.c_rr[i]),
            resistance_std=_known(lost.c_std[i]),
            grade=_known(lost.grade[i]),
            trend=_known(self._trends[i]),
            unmeasured=float(lost.unmeasured[i]),
            passes_ph=tuple(passes.tolist()),
            tonnes_ph=tuple((passes * lost.kg[i] / 1000).tolist()),
            guessed=bool(lost.guessed[i]),
            machines=int(self._machines[i]),
        )


def _known(value: float) -> float | None:
    return None if math.isnan(value) else float(value)
