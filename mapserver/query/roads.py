"""Queries about roads answered: segments with what drove on them, and the worklist."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from mapserver.query.road_maps import RoadMap
from mapserver.roads.ledger import Ledger
from mapserver.roads.loss import Losses, losses
from mapserver.roads.segments import Segments
from mapserver.roads.tally import HOUR_NS
from mapserver.roads.trend import DAY_NS, Daily, daily, trends
from mapserver.roads.worklist import litres, ranked, seconds
from protocol.arrays import Floats, Ints
from protocol.errors import QueryError, Refusal
from protocol.queries import roads as answers
from protocol.queries.requests import RoadQuery, SegmentsQuery, WorklistQuery
from protocol.site.geometry import Bounds

MOST_SEGMENTS = 10_000  # of one answer: 250 km of roads, 3 MB
MOST_CHANGES = 1000  # of one worklist, the newest
LINE_POINTS = 5  # a point of a line is a metre from the next; one in so many is told
KWH = 3.6e6  # J
Read = Callable[[int | None, str], RoadMap]  # as of a time, with the traffic of one machine: as `RoadMaps.read`


def segments(read: Read, query: SegmentsQuery, extent_m: float) -> answers.Segments:
    """Roads, and what drove on them."""
    roads, traffic, hours = _read(read, query, extent_m)
    rows = _Records(roads.segments, traffic, losses(traffic, roads.segments, 0.0), hours)
    chosen = _inside(roads.segments, query.bounds)
    if len(chosen) > MOST_SEGMENTS:
        problem = f"{len(chosen)} segments; at most {MOST_SEGMENTS} are answered: ask for less with `bounds`"
        raise QueryError(Refusal.TOO_LARGE, problem)
    return answers.Segments(*_version(roads), hours, traffic.placed, tuple(map(rows, sorted(chosen))))


def worklist(read: Read, query: WorklistQuery, extent_m: float) -> answers.Worklist:
    """Where work pays."""
    roads, traffic, hours = _read(read, query, extent_m)
    before, after = _levels(roads)
    lost = losses(traffic, roads.segments, query.target, after)
    saved_j = losses(traffic, roads.segments, query.target, before).work_j - lost.work_j
    rows, listed = _Records(roads.segments, traffic, lost, hours), ranked(lost)
    inside, since_ns, days = _inside(roads.segments, query.bounds), roads.since_ns(), daily(traffic)
    work = np.stack([lost.work_j, lost.low_j, lost.high_j]) / max(hours, 1e-9)
    saved_kwh_ph = saved_j / max(hours, 1e-9) / KWH
    kg = lost.kg.mean(axis=1)
    out: list[answers.WorklistRow] = []
    for i, rank in zip(listed.order.tolist(), listed.rank.tolist(), strict=True):
        if i in inside and len(out) < query.limit:
            of_it = (work[:, i] / KWH, litres(work[:, i], query.efficiency), seconds(work[:, i], kg[i]))
            changed = math.isfinite(before[i])
            out.append(
                answers.WorklistRow(
                    rank,
                    rows(i),
                    *(tuple(values.tolist()) for values in of_it),
                    since_ns=int(since_ns[i]),
                    before=_known(before[i]),
                    saved_kwh_ph=float(saved_kwh_ph[i]) if changed else None,
                    **_days(days, i),
                )
            )
    changes = tuple(
        answers.RoadChange(
            roads.segments.ids[change.segment],
            rows(change.segment).line,
            change.first_ns,
            change.seen_ns,
            change.before,
            change.after,
            float(saved_kwh_ph[change.segment]),
        )
        for change in [change for change in roads.changes if change.segment in inside][:MOST_CHANGES]
    )
    total = float(work[0, sorted(inside)].sum() / KWH)
    return answers.Worklist(*_version(roads), hours, query.target, total, tuple(out), changes)


def _read(read: Read, query: RoadQuery, extent_m: float) -> tuple[RoadMap, Ledger, float]:
    """The roads that a query is about, the ledger of its hours, and how many hours these are."""
    _require_on_site(query.bounds, extent_m)
    roads = read(query.as_of_ns, query.machine)
    from_ns, to_ns = query.from_ns or 0, query.to_ns or 2**62
    return roads, *roads.hours_with_driving(from_ns // HOUR_NS * HOUR_NS, to_ns)


def _version(roads: RoadMap) -> tuple[str, int, int, int]:
    return roads.version.store, roads.version.row, roads.version.fact, roads.stamp_ns


def _require_on_site(bounds: Bounds | None, extent_m: float) -> None:
    if bounds is None:
        return
    inside = bounds.west_m < extent_m and bounds.east_m > -extent_m
    if not (inside and bounds.south_m < extent_m and bounds.north_m > -extent_m):
        problem = f"`bounds` lie off the site, which reaches {extent_m:g} m from its origin"
        raise QueryError(Refusal.OUT_OF_RANGE, problem)


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


def _days(days: Daily, segment: int) -> dict[str, tuple[float, ...]]:
    """Days of one segment as fields of a row."""
    own = slice(*np.searchsorted(days.segment, [segment, segment + 1]))
    day_ns = (days.day[own] * DAY_NS).tolist()
    return {"day_ns": tuple(day_ns), "day_resistance": tuple(days.c_rr[own].tolist())}


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
