"""Lanes over Zenoh: asks the map server for those around the machine; without a link the last ones hold.

Replies arrive on Zenoh's threads and wait for the agent's, which owns the filter.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import dataclass

import zenoh

from agents.localisation.filters.belief import PoseBelief
from agents.localisation.lanes.lane_map import LaneMap
from protocol.errors import MessageError
from protocol.queries.lanes import LanesAnswer, LanesQuery, decode_lanes
from protocol.queries.parameters import selector_of
from protocol.site.geometry import Bounds
from protocol.wire import keys

# Interval in machine time without answer or lanes; each answer multiplies it by SLOWER, as an old map changes little. A
# full answer has 8 to 15 kB.
AGAIN_S, MOST_S, SLOWER = 60.0, 1800.0, 5
ANSWER_S = 20.0
REACH_M = 1000.0  # half width of the requested square
MOVED_M = 500.0  # distance from its middle at which another one is requested


@dataclass(frozen=True)
class KnownLanes:
    """Known lanes around a place."""

    middle_m: tuple[float, float]
    answer: LanesAnswer
    lanes: LaneMap

    def question(self, pose: PoseBelief) -> LanesQuery:
        """The query that updates them for a pose."""
        is_near = math.dist(self.middle_m, (pose.x_m, pose.y_m)) < MOVED_M
        if not is_near or not self.answer.stamp_ns:  # 0: nobody had driven
            return first_question(pose)
        return LanesQuery(_around(self.middle_m), self.answer.stamp_ns)


def first_question(pose: PoseBelief) -> LanesQuery:
    """All lanes around a pose."""
    return LanesQuery(_around((round(pose.x_m), round(pose.y_m))))


def _around(middle_m: tuple[float, float]) -> Bounds:
    x_m, y_m = middle_m
    return Bounds(x_m - REACH_M, y_m - REACH_M, x_m + REACH_M, y_m + REACH_M)


def known_after(known: KnownLanes | None, query: LanesQuery, answer: LanesAnswer) -> KnownLanes | None:
    """The lanes after an answer; None if it does not continue the known ones."""
    assert query.bounds is not None
    middle_m = query.bounds.west_m + REACH_M, query.bounds.south_m + REACH_M
    tiles = {(tile.x, tile.y): tile for tile in answer.tiles}
    if query.since_ns is not None:
        if known is None or _map_of(answer) != _map_of(known.answer):
            return None
        tiles = {**known.lanes.tiles, **tiles}
    return KnownLanes(middle_m, answer, LaneMap(answer.cell_m, tiles))


def _map_of(answer: LanesAnswer) -> tuple[str, int]:
    """Store and decisions; while equal, squares without new samples stay."""
    return answer.version.store, answer.version.fact


class LaneLink:
    """Keeps the lanes around one machine. known: the newest."""

    def __init__(self, session: zenoh.Session, site: str) -> None:
        self.known: KnownLanes | None = None
        self.counters: Counter[str] = Counter()
        self._session, self._key = session, keys.map_query(site, LanesQuery.name)
        self._replies: deque[tuple[LanesQuery, bytes]] = deque(maxlen=2)
        self._next_s, self._rest_s = 0.0, AGAIN_S

    def look(self, pose: PoseBelief | None) -> LaneMap | None:
        """Process answers, ask if due; returns new lanes or None."""
        if pose is None:
            return None
        now_s = pose.stamp_ns * 1e-9
        fresh: LaneMap | None = None
        while self._replies:
            query, data = self._replies.popleft()
            if answer := self._answer(data):
                self.known = known_after(self.known, query, answer)
                fresh = self.known.lanes if self.known else None
                if fresh and fresh.tiles:
                    self._rest_s = min(SLOWER * self._rest_s, MOST_S)
                self._next_s = now_s + self._rest_s * bool(fresh)  # immediately if all must be requested anew
        if not self._next_s - MOST_S <= now_s < self._next_s:  # a clock may be set back
            self._ask(self.known.question(pose) if self.known else first_question(pose))
            self._next_s = now_s + AGAIN_S
        return fresh if fresh and fresh.tiles else None

    def _ask(self, query: LanesQuery) -> None:
        def on_reply(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                self._replies.append((query, reply.ok.payload.to_bytes()))

        selector = zenoh.Selector(self._key, selector_of(query.parameters()))
        self._session.get(selector, on_reply, timeout=ANSWER_S)

    def _answer(self, data: bytes) -> LanesAnswer | None:
        try:
            answer = decode_lanes(data)
        except MessageError as error:
            self.counters[f"lanes_refused_{error.reason}"] += 1
            return None
        self.counters["lanes_bytes"] += len(data)
        return answer
