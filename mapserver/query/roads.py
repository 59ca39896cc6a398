"""Answers about roads: segments with traffic, and the worklist."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from mapserver.error_model import NINETY
from mapserver.query.road_maps import RoadMap
from mapserver.roads.fuel import litres_of
from mapserver.roads.ledger import Ledger
from mapserver.roads.loss import Losses, losses
from mapserver.roads.repairs import Repair
from mapserver.roads.segments import SegmentTable
from mapserver.roads.worklist import Daily, daily, litres, ranked, seconds, trends
from protocol.arrays import Floats, Ints
from protocol.errors import QueryError, Refusal
from protocol.queries import roads as answers
from protocol.queries.roads import RoadQuery, SegmentsQuery, WorklistQuery
from protocol.site.geometry import Bounds
from protocol.units import DAY_NS, HOUR_NS, JOULE_PER_KWH

MOST_SEGMENTS = 10_000  # segments per answer: 250 km of roads, 3 MB
MOST_CHANGES = 1000  # newest changes per worklist
LINE_POINTS = 5  # every fifth point of a line is sent; points are a metre apart
Read = Callable[[int | None, str], RoadMap]  # as `RoadMaps.read`: as of a time, with one machine's traffic


def segments(read: Read, query: SegmentsQuery) -> answers.Segments:
    """Roads with their traffic."""
    roads, traffic, hours = _read(read, query)
    rows = _Records(roads, traffic, _lost(roads, traffic, 0.0), hours)
    chosen = _inside(roads.segments, query.bounds)
    if len(chosen) > MOST_SEGMENTS:
        problem = f"{len(chosen)} segments; at most {MOST_SEGMENTS} are answered: ask for less with `bounds`"
        raise QueryError(Refusal.TOO_LARGE, problem)
    return answers.Segments(*_version(roads), hours, traffic.placed, tuple(rows.of_segments(sorted(chosen))))


def worklist(read: Read, query: WorklistQuery) -> answers.Worklist:
    """Road sections worth grading."""
    roads, traffic, hours = _read(read, query)
    lost, saved_j = _lost(roads, traffic, query.target), _saved_j(roads, traffic, query.target)
    saved_kwh_ph = {change: joules / max(hours, 1e-9) / JOULE_PER_KWH for change, joules in saved_j.items()}
    rows = _Rows(_Records(roads, traffic, lost, hours), roads, daily(traffic), saved_kwh_ph, query.efficiency)
    listed, inside = ranked(lost), _inside(roads.segments, query.bounds)
    ranks = [(i, rank) for i, rank in zip(listed.order.tolist(), listed.rank.tolist(), strict=True) if i in inside]
    changes = [change for change in roads.changes if change.segment in inside]
    return answers.Worklist(
        *_version(roads),
        hours,
        query.target,
        float(lost.work_j[sorted(inside)].sum() / max(hours, 1e-9) / JOULE_PER_KWH),
        tuple(rows.of_segments(ranks[: query.limit])),
        tuple(rows.of_changes(changes[:MOST_CHANGES])),
    )


def _read(read: Read, query: RoadQuery[Any]) -> tuple[RoadMap, Ledger, float]:
    """Roads of a query, its ledger, and its hours."""
    roads = read(query.as_of_ns, query.machine)
    from_ns, to_ns = query.from_ns or 0, query.to_ns or 2**62
    return roads, *roads.hours_with_driving(from_ns // HOUR_NS * HOUR_NS, to_ns)


def _version(roads: RoadMap) -> tuple[str, int, int, int]:
    return roads.version.store, roads.version.row, roads.version.fact, roads.stamp_ns


def _lost(roads: RoadMap, traffic: Ledger, target: float) -> Losses:
    """Losses of this traffic on ground as of its last change."""
    _, after = _levels(roads.segments, roads.last_changes.values())
    return losses(traffic, roads.segments, target, after)


def _saved_j(roads: RoadMap, traffic: Ledger, target: float) -> dict[Repair, float]:
    """Work [J] that each change saves for this traffic, one change per segment at a time."""
    out: dict[Repair, float] = {}
    left = list(roads.changes)
    while left:
        some = {change.segment: change for change in left}
        before, after = (
            losses(traffic, roads.segments, target, level).work_j for level in _levels(roads.segments, some.values())
        )
        out |= {change: float(before[segment] - after[segment]) for segment, change in some.items()}
        left = [change for change in left if change not in out]
    return out


def _levels(roads: SegmentTable, changes: Iterable[Repair]) -> tuple[Floats, Floats]:
    """c_rr (k,) before and after these changes, NaN for none."""
    before, after = np.full((2, len(roads.ids)), np.nan)
    for change in changes:
        before[change.segment], after[change.segment] = change.before, change.after
    return before, after


def _inside(roads: SegmentTable, bounds: Bounds | None) -> set[int]:
    """Segments with their middle in a rectangle."""
    if bounds is None:
        return set(range(len(roads.ids)))
    middle = roads.points[(roads.ends[:-1] + roads.ends[1:]) // 2] if len(roads.ids) else roads.points
    x, y = middle.T
    within = (x >= bounds.west_m) & (x < bounds.east_m) & (y >= bounds.south_m) & (y < bounds.north_m)
    return set(np.flatnonzero(within).tolist())


class _Records:
    """Records of segments, by number. lost: in these hours."""

    def __init__(self, roads: RoadMap, traffic: Ledger, lost: Losses, hours: float) -> None:
        self._segments, self.lost, self.hours = roads.segments, lost, max(hours, 1e-9)
        self._trends, self._fuel = trends(traffic), litres_of(traffic, roads.segments, lost)
        machines = traffic.totals()["machines"]
        self._machines: Ints = np.bitwise_count(machines[:, 0] | machines[:, 1]).astype(np.int64)

    def of_segments(self, chosen: Sequence[int]) -> list[answers.RoadSegment]:
        """Records of these segments, made column by column."""
        at, lost = np.array(chosen, np.int64), self.lost
        passes = lost.passes[at] / self.hours
        columns: tuple[Iterable[Any], ...] = (
            [self._segments.ids[i] for i in chosen],
            self.lines(chosen),
            self._segments.length_m[at].tolist(),
            *(_known(values[at]) for values in (lost.c_rr, lost.c_std, lost.grade, self._trends)),
            lost.unmeasured[at].tolist(),
            map(tuple, passes.tolist()),
            map(tuple, (passes * lost.kg[at] / 1000).tolist()),
            lost.guessed[at].tolist(),
            self._machines[at].tolist(),
            self.fuel(chosen),
        )
        return list(map(answers.RoadSegment, *columns))

    def fuel(self, chosen: Sequence[int]) -> list[answers.Fuel | None]:
        """Burned and predicted fuel of segments."""
        fuel, at = self._fuel, np.array(chosen, np.int64)
        if fuel is None:
            return [None] * len(chosen)
        burned = fuel.burned[at, None] + np.array([0.0, -NINETY, NINETY]) * fuel.burned_std[at, None]
        predicted = np.stack([fuel.predicted[at], fuel.low[at], fuel.high[at]], axis=1)
        litres_ph = (map(tuple, (litres / self.hours).tolist()) for litres in (burned, predicted))
        some = list(map(answers.Fuel, *litres_ph, fuel.share[at].tolist()))
        return [one if one.share else None for one in some]

    def lines(self, chosen: Sequence[int]) -> list[answers.Corners]:
        """Some points of each of these segments' lines."""
        lines = list(map(self._segments.line, chosen))
        some = (np.concatenate([line[:-1:LINE_POINTS], line[-1:]]).round(2).tolist() for line in lines)
        return [tuple(map(tuple, points)) for points in some]


class _Rows:
    """Rows of a worklist, and changes, by segment number. saved_kwh_ph: by change."""

    def __init__(
        self,
        records: _Records,
        roads: RoadMap,
        days: Daily,
        saved_kwh_ph: Mapping[Repair, float],
        efficiency: float,
    ) -> None:
        self._records, self._ids, self._days = records, roads.segments.ids, days
        self._saved_kwh_ph, self._efficiency = saved_kwh_ph, efficiency
        self._last, self._since_ns = roads.last_changes, roads.since_ns()
        lost = records.lost
        self._work = np.stack([lost.work_j, lost.low_j, lost.high_j], axis=1) / records.hours
        self._kg = lost.kg.mean(axis=1)

    def of_segments(self, ranks: Sequence[tuple[int, int]]) -> list[answers.WorklistRow]:
        """Rows of these segments and ranks, made column by column."""
        chosen, at = [i for i, _ in ranks], np.array([i for i, _ in ranks], np.int64)
        work, changes = self._work[at], [self._last.get(i) for i in chosen]
        a_row = work / JOULE_PER_KWH, litres(work, self._efficiency), seconds(work, self._kg[at, None])
        days = list(map(slice, *(np.searchsorted(self._days.segment, side).tolist() for side in (at, at + 1))))
        columns: tuple[Iterable[Any], ...] = (
            [rank for _, rank in ranks],
            self._records.of_segments(chosen),
            *(map(tuple, values.tolist()) for values in a_row),
            self._since_ns[at].tolist(),
            [change.before if change else None for change in changes],
            [self._saved_kwh_ph[change] if change else None for change in changes],
            [tuple((self._days.day[some] * DAY_NS).tolist()) for some in days],
            [tuple(self._days.c_rr[some].tolist()) for some in days],
        )
        return list(map(answers.WorklistRow, *columns))

    def of_changes(self, changes: Sequence[Repair]) -> list[answers.RoadChange]:
        """Changes of the ground."""
        chosen = [change.segment for change in changes]
        columns: tuple[Iterable[Any], ...] = (
            [self._ids[i] for i in chosen],
            self._records.lines(chosen),
            *([getattr(change, name) for change in changes] for name in ("first_ns", "seen_ns", "before", "after")),
            [self._saved_kwh_ph[change] for change in changes],
            self._records.fuel(chosen),
        )
        return list(map(answers.RoadChange, *columns))


def _known(values: Floats) -> list[float | None]:
    return [None if math.isnan(value) else value for value in values.tolist()]
