"""Lanes: loaded on demand, refreshed, only if newer; kept without a link."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np

from agents.lane_link import AGAIN_S, MOST_S, MOVED_M, SLOWER, LaneLink
from agents.localisation.filters.belief import PoseBelief
from protocol.queries.answers import MapVersion
from protocol.queries.lanes import SHAPE, SLOPES, LanesAnswer, LanesQuery, LaneTile, encode_lanes
from protocol.queries.parameters import split_selector

STORE = "0123456789abcdef"
BEGIN_S = 1e9


class Network:
    """A session with tiles by place that records its queries."""

    def __init__(self) -> None:
        self.asked: list[LanesQuery] = []
        self.tiles: dict[tuple[int, int], int] = {}  # newest stamp by place
        self.fact, self.is_up = 0, True

    def get(self, selector: Any, on_reply: Callable[[Any], None], timeout: float) -> None:
        query = LanesQuery(**self._fields(str(selector.parameters)))
        self.asked.append(query)
        if not self.is_up:
            return
        tiles = tuple(
            LaneTile(x, y, newest, 1, 1, 1, np.zeros(SHAPE, np.uint8), np.zeros(SLOPES, np.int8))
            for (x, y), newest in self.tiles.items()
            if newest > (query.since_ns or 0)
        )
        answer = LanesAnswer(MapVersion(STORE, 7, self.fact), max(self.tiles.values(), default=0), 1.0, tiles)
        payload = SimpleNamespace(to_bytes=lambda: encode_lanes(answer))
        on_reply(SimpleNamespace(ok=SimpleNamespace(payload=payload)))

    def _fields(self, text: str) -> dict[str, Any]:
        from protocol.queries.requests import parse_query

        return vars(parse_query("lanes", split_selector(text)))


def at(x_m: float, now_s: float) -> PoseBelief:
    return PoseBelief(round((BEGIN_S + now_s) * 1e9), x_m, 0.0, 0.0, 1.0, np.eye(2))


def test_lanes_are_kept_up_to_date():
    network = Network()
    link = LaneLink(network, "site")  # type: ignore[arg-type]
    assert link.look(None) is None
    assert not network.asked  # place of the machine unknown
    for now_s in (-100.0, -99.0, -98.0):  # nobody has driven
        assert link.look(at(3.0, now_s)) is None
    network.tiles = {(0, 0): 10, (1, 0): 20}
    link.look(at(3.0, 1.0))
    lanes = link.look(at(3.0, 2.0))
    assert lanes is not None
    assert set(lanes.tiles) == {(0, 0), (1, 0)}
    assert link.look(at(3.0, 3.0)) is None
    assert len(network.asked) == 2

    network.tiles[0, 0] = 30
    network.is_up = False
    for now_s in np.arange(3.0, 2.0 + (SLOWER + 4) * AGAIN_S, 1.0):  # no link: rare retries
        assert link.look(at(3.0, float(now_s))) is None
    assert len(network.asked) - 2 == 4
    network.is_up = True
    link.look(at(3.0, 2 * MOST_S))
    lanes = link.look(at(3.0, 2 * MOST_S + 1))
    assert network.asked[-1].since_ns == 20
    assert lanes is not None
    assert {place: tile.newest_ns for place, tile in lanes.tiles.items()} == network.tiles


def test_lanes_are_asked_for_ever_more_seldom():
    network = Network()
    link = LaneLink(network, "site")  # type: ignore[arg-type]
    network.tiles = {(0, 0): 10}
    for now_s in range(8 * 3600):
        link.look(at(3.0, float(now_s)))
        if now_s == 3599:
            assert len(network.asked) == 3  # 8 to 15 kB each
    assert 8 * 3600 / MOST_S < len(network.asked) < 8 * 3600 / MOST_S + 6
    link.look(at(3.0, -1e6))  # clock set back
    assert network.asked[-1].since_ns == 10


def test_lanes_are_asked_for_anew_far_away_and_after_a_decision():
    network = Network()
    link = LaneLink(network, "site")  # type: ignore[arg-type]
    network.tiles = {(0, 0): 10}
    link.look(at(0.0, 0.0))
    assert link.look(at(0.0, 1.0))
    link.look(at(MOVED_M + 1, MOST_S + 1))
    assert network.asked[-1].since_ns is None
    assert link.look(at(MOVED_M + 1, MOST_S + 2))
    network.fact = 1  # a machine was excluded: squares without new samples change too
    link.look(at(MOVED_M + 1, 2 * MOST_S + 3))
    assert network.asked[-1].since_ns == 10
    assert link.look(at(MOVED_M + 1, 2 * MOST_S + 4)) is None
    assert network.asked[-1].since_ns is None
    lanes = link.look(at(MOVED_M + 1, 2 * MOST_S + 5))
    assert lanes is not None
    assert set(lanes.tiles) == {(0, 0)}


def test_what_is_no_answer_is_counted():
    network = Network()
    network.get = lambda _, on_reply, timeout: on_reply(  # type: ignore[method-assign]
        SimpleNamespace(ok=SimpleNamespace(payload=SimpleNamespace(to_bytes=lambda: b"\x80")))
    )
    link = LaneLink(network, "site")  # type: ignore[arg-type]
    link.look(at(0.0, 0.0))
    assert link.look(at(0.0, 1.0)) is None
    assert sum(link.counters.values()) == 1
