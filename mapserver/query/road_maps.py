"""Road maps: roads, their traffic tally and repairs, now and as of any time.

The tally follows the journal. Roads are made from one map version in the background; queries use the newest, a few
seconds old. What their passes show of repairs is for the writer to decide (mapserver/upkeep/road_repairs.py).
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mapserver.evidence.fold_config import FoldConfig, is_foldable, name_hash
from mapserver.evidence.grid import Grid
from mapserver.journal.facts import NO_FACTS, Facts
from mapserver.journal.history import release_memory
from mapserver.journal.rows import Selection
from mapserver.query.source import MapReading, MapState
from mapserver.query.views import check_past
from mapserver.roads.ledger import Ledger, Ledgers
from mapserver.roads.network import network
from mapserver.roads.passes import Passes, PassTally
from mapserver.roads.repair_facts import RoadRepair
from mapserver.roads.repairs import Repair, Strips, repairs, since
from mapserver.roads.segments import SegmentTable, segments
from mapserver.roads.skeleton import Pages, Skeletons
from mapserver.roads.tally import Tally, between
from protocol.arrays import Ints, Table
from protocol.errors import QueryError, Refusal, StoreError
from protocol.machine.readings import MAX_STAMP_NS
from protocol.machine.samples import SAMPLE_DTYPE
from protocol.queries.answers import MapVersion
from protocol.site.geometry import CellWindow
from protocol.units import HOUR_NS

log = logging.getLogger("mapserver.query.road_maps")
# Largest age of roads in answers [s]: repairs need minutes to be seen, and roads are planned on for minutes. Making
# them every second would cost queries 0.1 s.
FRESH_S = 10.0
# Largest age relative to the last making, 1 % of the time, so that small or new sites get fresh answers.
CHEAP = 100
COSTLY = 20  # least age relative to the last making, so that large maps cost no more than 5 %
SPARE = 3  # lead before roads are too old, in durations of the last making
ASKED_S = 600.0  # time after the last question during which roads are made
LOOK_BACK_NS = 30 * 24 * HOUR_NS  # traffic before the site's now; older rows are not read


@dataclass(frozen=True)
class RoadMap:
    """Roads of one map version, with their tally."""

    ledgers: Ledgers
    tally: Table
    facts: Facts
    version: MapVersion
    stamp_ns: int
    cell_m: float

    @property
    def segments(self) -> SegmentTable:
        """Its segments."""
        return self.ledgers.segments

    @cached_property
    def strips(self) -> Strips:
        """Cells of its segments."""
        return Strips(self.segments, self.cell_m)

    @cached_property
    def changes(self) -> tuple[Repair, ...]:
        """Repairs proved by then, as long ago as traffic counts, newest first."""
        first_ns, standing = self.stamp_ns - LOOK_BACK_NS, self.facts.repairs.standing
        proved = (repair for repair in standing.values() if first_ns < repair.seen_ns <= self.stamp_ns)
        return tuple(sorted(self.strips.placed(proved), key=lambda one: (-one.seen_ns, one.segment, -one.first_ns)))

    @cached_property
    def ledger(self) -> Ledger:
        """The ledger of all remembered hours."""
        return self.ledgers.ledger(self.tally, HOUR_NS)

    def hours_with_driving(self, from_ns: int, to_ns: int) -> tuple[Ledger, float]:
        """The ledger of hours that begin in from_ns <= time < to_ns, and their number, the running one in part."""
        whole = from_ns <= 0 and to_ns > self.stamp_ns
        traffic = self.ledger if whole else self.ledgers.ledger(self.tally, HOUR_NS, from_ns, to_ns)
        slots = np.unique(traffic.rows["slot"])
        ends = np.minimum((slots + 1) * HOUR_NS, max(self.stamp_ns, 1))
        return traffic, float(np.maximum(ends - slots * HOUR_NS, 0).sum() / HOUR_NS)

    def since_ns(self) -> Ints:
        """Start (k,) of segments' present ground: last change, or first measured hour."""
        rows = self.ledger.rows[self.ledger.rows["measured"] > 0]
        out = np.zeros(len(self.segments.ids), np.int64)
        known, first = np.unique(rows["segment"], return_index=True)  # by segment, then slot
        out[known] = rows["slot"][first] * HOUR_NS
        for segment, change in self.last_changes.items():
            out[segment] = change.first_ns
        return out

    @cached_property
    def last_changes(self) -> dict[int, Repair]:
        """The last change of each changed segment."""
        return {change.segment: change for change in reversed(self.changes)}


class Traffic:
    """Traffic by hour and by pass."""

    def __init__(self) -> None:
        self.tally, self.passes = Tally(), PassTally()

    def add(self, rows: Table, names: NDArray[np.uint64]) -> None:
        """As `Tally.add`."""
        self.tally.add(rows, names)
        self.passes.add(rows, names)


@dataclass(frozen=True)
class _Newest:
    """The newest roads, when the map was last checked [s], and how long they took.

    passes: over them, all that there were since since_ns.
    """

    roads: RoadMap
    looked_s: float
    took_s: float
    passes: Passes
    since_ns: int

    @property
    def lasts_s(self) -> float:
        """Time for which they are new enough."""
        return max(min(FRESH_S, CHEAP * self.took_s), COSTLY * self.took_s)


@contextmanager
def _journal_read() -> Iterator[None]:
    """Turn journal errors into a QueryError."""
    try:
        yield
    except StoreError as error:
        raise QueryError(Refusal.STORE, str(error)) from None


class RoadMaps:
    """Road maps of one source. Thread-safe; one thread at a time makes present ones.

    made, made_s: their number and total time.
    """

    def __init__(self, source: MapReading, clock: Callable[[], float] = time.monotonic) -> None:
        """clock: monotonic [s]."""
        self._source, self._cell_m, self._config = source, source.site.cell_m, source.config
        self._clock = clock
        self._lock = threading.Lock()
        self._skeletons = Skeletons(self._cell_m)
        self._newest: _Newest | None = None
        self.made, self.made_s = 0, 0.0
        self._asked_s = -math.inf  # never
        self._examined: RoadMap | None = None
        self._begin("", NO_FACTS)

    def _begin(self, store: str, facts: Facts) -> None:
        """Restart following the journal."""
        self._traffic, self._followed, self._with = Traffic(), 0, (store, facts)

    def begin(self) -> None:
        """Have the first `renew` make roads of an existing map: the first query would wait for its whole journal."""
        with suppress(QueryError):  # a follower without a map yet
            if self._source.run(lambda state: state.version.row):
                self._ask()

    def read(self, as_of_ns: int | None = None, machine: str = "") -> RoadMap:
        """Roads as of a time, or recent ones; machine: only its traffic. Raises QueryError."""
        if machine and not self._source.run(lambda state: machine in state.machines()):
            raise QueryError(Refusal.UNKNOWN_MACHINE, f"machine `{machine[:40]}` has sent nothing")
        with _journal_read():
            if as_of_ns is not None:
                return self._as_of(as_of_ns, machine)
            roads = self._lately()
            return self._alone(roads, machine) if machine else roads

    def reach(self, row: int) -> None:
        """Require roads of this journal row or later. Raises QueryError."""
        with _journal_read(), self._lock:
            if not self._newest or self._newest.roads.version.row < row:
                self._now()

    def repairs(self) -> tuple[MapVersion, list[RoadRepair]] | None:
        """Repairs that recent passes show, and withdrawals, for a version of the map; None if nothing is new.

        Keeps roads new, but waits for nobody who makes them.
        """
        if not self._source.run(lambda state: state.version.row):
            return None
        newest, asked_s = self._newest, self._ask()
        if not newest or asked_s - newest.looked_s >= max(FRESH_S, COSTLY * newest.took_s):
            if not self._lock.acquire(blocking=False):
                return None
            try:
                with _journal_read():
                    self._now()
            finally:
                self._lock.release()
            newest = self._newest
        if not newest or newest.roads is self._examined:
            return None
        self._examined = roads = newest.roads
        facts, since_ns = roads.facts.repairs, newest.since_ns
        rootless = (one for one in facts.standing.values() if one.known_ns < since_ns <= one.first_ns)
        changes, _ = repairs(since(newest.passes, roads.strips.placed(rootless)))
        shown = {(roads.segments.ids[one.segment], one.first_ns): one for one in changes}
        proved = {key for key, one in facts.standing.items() if one.seen_ns <= roads.stamp_ns}
        fresh = roads.strips.located((one for key, one in shown.items() if key not in proved), roads.stamp_ns)
        events = facts.judged(fresh, shown.keys() & proved, since_ns, roads.stamp_ns)
        return (roads.version, events) if events else None

    def renew(self) -> float:
        """Make present roads, unless there were no questions for long; returns seconds until the next time."""
        began_s = self._clock()
        try:
            if began_s - self._asked_s < ASKED_S:
                with _journal_read(), self._lock:
                    self._now()
        except QueryError as error:  # queries get the same answer
            log.info("no road map reason=%s problem=%r", error.reason, str(error))
        took_s = self._clock() - began_s
        # at most half of the time
        return max(max(FRESH_S, COSTLY * took_s) - SPARE * took_s, took_s)

    def _lately(self) -> RoadMap:
        """The newest roads, if fresh, or those being made."""
        asked_s = self._ask()
        if roads := self._fresh(asked_s):
            return roads
        with self._lock:
            return self._fresh(asked_s) or self._now()

    def _ask(self) -> float:
        """Note a question, and its time."""
        self._asked_s = self._clock()
        return self._asked_s

    def _fresh(self, asked_s: float) -> RoadMap | None:
        """Roads fresh enough for a question of this time, and of the map's facts."""
        newest = self._newest
        if newest is None:
            return None
        own, now = newest.roads.version, self._source.run(lambda state: state.version)
        is_of_map = (own.store, own.fact) == (now.store, now.fact) and own.row <= now.row
        in_time = own == now or asked_s - newest.looked_s <= newest.lasts_s
        return newest.roads if is_of_map and in_time else None

    def _now(self) -> RoadMap:
        """Make present roads, unless the newest are."""
        looked_s, newest = self._clock(), self._newest
        # version first, because pages of all blocks cost their owner milliseconds
        version, facts = self._source.run(lambda state: (state.version, state.facts))
        if newest and (replace(newest.roads.version, fact=version.fact), newest.roads.facts) == (version, facts):
            same = newest.roads.version == version  # otherwise with other repairs
            roads = newest.roads if same else replace(newest.roads, facts=facts, version=version)
            self._newest = replace(newest, roads=roads, looked_s=looked_s)
            return roads
        pages, version, facts, newest_ns = self._source.run(_all)
        if self._with != (version.store, facts):
            self._begin(version.store, facts)
        self._follow(self._traffic, facts, newest_ns, self._followed, version.row)
        self._followed = version.row
        ledgers = Ledgers(segments(network(self._skeletons.skeleton(pages))))
        roads = self._map(ledgers, self._traffic.tally, facts, version, newest_ns)
        _ = roads.changes  # here rather than in the first query
        from_ns = _first_hour(newest_ns) * HOUR_NS
        passes = self._traffic.passes.passes(ledgers, from_ns)
        release_memory()
        took_s = self._clock() - looked_s
        self._newest = _Newest(roads, looked_s, took_s, passes, max(from_ns, self._traffic.passes.since_ns))
        self.made, self.made_s = self.made + 1, self.made_s + took_s
        return roads

    def _as_of(self, as_of_ns: int, machine: str) -> RoadMap:
        self._source.run(lambda state: check_past(state, None, 0))
        version, facts = self._source.run(lambda state: (state.version, state.facts))
        traffic = Tally()
        with self._source.location.reader() as reader:
            grid = self._source.past.grid_as_of(reader, as_of_ns, None, facts)
        self._follow(traffic, facts, as_of_ns, 0, version.row, as_of_ns, machine)
        ledgers = Ledgers(segments(network(Skeletons(self._cell_m).skeleton(_pages(grid)))))
        return self._map(ledgers, traffic, facts, version, as_of_ns)

    def _alone(self, roads: RoadMap, machine: str) -> RoadMap:
        """The same roads with one machine's traffic, read from the journal."""
        traffic = Tally()
        self._follow(traffic, roads.facts, roads.stamp_ns, 0, roads.version.row, machine=machine)
        return self._map(roads.ledgers, traffic, roads.facts, roads.version, roads.stamp_ns)

    def _follow(
        self,
        traffic: Traffic | Tally,
        facts: Facts,
        newest_ns: int,
        after: int,
        until: int,
        to_ns: int = MAX_STAMP_NS,
        machine: str = "",
    ) -> None:
        """Add rows after < row <= until to the traffic: samples up to `to_ns`, of one machine or all."""
        if after >= until:
            return
        begin_ns = _first_hour(newest_ns) * HOUR_NS
        with self._source.location.reader() as reader:
            selection = Selection.by(facts, begin_ns, to_ns)
            for samples, names in self._source.past.samples(reader, selection, after, until):
                wanted = is_foldable(samples, self._config.fold)
                if machine:
                    wanted &= names == np.uint64(name_hash(machine))
                traffic.add(samples[wanted], names[wanted])

    def _map(self, ledgers: Ledgers, traffic: Tally, facts: Facts, version: MapVersion, stamp_ns: int) -> RoadMap:
        """Assemble a road map; limits the look back, independently of when the journal was followed."""
        table = between(traffic.table(), _first_hour(stamp_ns), MAX_STAMP_NS // HOUR_NS + 1)
        return RoadMap(ledgers, table, facts, version, stamp_ns, self._cell_m)


def _first_hour(stamp_ns: int) -> int:
    """First hour whose traffic counts at a time."""
    return max(0, stamp_ns - LOOK_BACK_NS) // HOUR_NS


def _all(state: MapState) -> tuple[Pages, MapVersion, Facts, int]:
    return _pages(state.grid), state.version, state.facts, state.newest_ns


def _pages(grid: Grid) -> Pages:
    bounds = grid.bounds()
    if bounds is None:
        return {}
    west, south, east, north = bounds
    blocks = grid.blocks_in(CellWindow(west, south, east - west, north - south))
    return dict(zip(blocks, grid.pages(blocks), strict=True))


def warm_up(config: FoldConfig) -> None:
    """Compile the kernels of roads, or load them, before a query waits for them."""
    rows = np.zeros(3 * 160, SAMPLE_DTYPE)  # a road: three passes along 80 m
    rows["x_m"], rows["distance_m"], rows["speed_mps"] = np.tile(np.arange(160) / 2, 3), 0.5, 5.0
    rows["cov_xx_m2"] = rows["cov_yy_m2"] = 0.25
    rows["c_rr"], rows["c_rr_var"], rows["mass_kg"] = 0.02, 1e-6, 1e4
    rows["stamp_ns"] = HOUR_NS + np.repeat(np.arange(3), 160) * 10**11 + np.tile(np.arange(160), 3) * 10**8
    grid, traffic = Grid(1.0, config), Traffic()
    grid.fold(rows, "")
    traffic.add(rows, np.full(len(rows), name_hash(""), np.uint64))
    ledgers = Ledgers(segments(network(Skeletons(1.0).skeleton(_pages(grid)))))
    ledgers.ledger(traffic.tally.table(), HOUR_NS)
    repairs(traffic.passes.passes(ledgers, 0))
