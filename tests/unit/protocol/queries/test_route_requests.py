"""Queries for routes: to parameters and back, and what is refused, by name."""

from __future__ import annotations

import pytest

from protocol.errors import QueryError, Refusal
from protocol.queries.parameters import Freshness, selector_of, split_selector
from protocol.queries.places import MAX_PLACES
from protocol.queries.requests import encode_query, parse_query
from protocol.queries.route_requests import REFUSE, TIME, RouteQuery, WayQuery
from protocol.queries.routing import MACHINES, RouteMachine

LINE = {"line": "0,0,30,40"}
ENDS = {"from": "0,0", "to": "30,40"}


@pytest.mark.parametrize(
    "query",
    [
        RouteQuery(((0.1, -0.2), (1e5 / 3, 7.0), (0.0, 0.0))),
        RouteQuery(((0.0, 0.0), (1.0, 1.0)), MACHINES["truck"], (False, True), 1.5, REFUSE, 17, Freshness(3, 5.0)),
        WayQuery((0.0, 0.0), (30.0, 40.0)),
        WayQuery(
            (0.0, 0.0), (3.0, 4.0), MACHINES["truck"], TIME, 0.1, 5.0, ((1.0, 2.0),), (False, False), 9.0, 0.05, 17
        ),
    ],
)
def test_a_query_goes_to_parameters_and_back(query):
    assert parse_query(query.name, split_selector(selector_of(encode_query(query)))) == query


def test_a_machine_is_a_kind_with_values_of_its_own():
    query = parse_query("route", {**LINE, "machine": "truck", "mass": "30000"})
    assert isinstance(query, RouteQuery)
    assert query.machine == RouteMachine(30_000.0, power_w=240_000.0, rotating=1.1)
    assert parse_query("route", LINE) == RouteQuery(((0.0, 0.0), (30.0, 40.0)))


def test_as_many_places_as_a_line_may_have():
    places = tuple((i / 3, 0.1) for i in range(MAX_PLACES))
    query = RouteQuery(places)
    assert parse_query("route", encode_query(query)) == query


@pytest.mark.parametrize(
    ("name", "parameters", "reason", "said"),
    [
        ("route", {}, Refusal.MISSING_FIELD, "`line` is missing"),
        ("route", {"line": "1,2"}, Refusal.OUT_OF_RANGE, "`line`: 1 places"),
        ("route", {"line": "1,2,1,2"}, Refusal.OUT_OF_RANGE, "`line`: places 1 and 2 are the same"),
        ("route", {"line": "0,0,1,2,1.0,2.0"}, Refusal.OUT_OF_RANGE, "`line`: places 2 and 3 are the same"),
        ("route", {"line": "1,2,nan,4"}, Refusal.NOT_FINITE, "`line`: nan"),
        ("route", {"line": "1,2,x,4"}, Refusal.WRONG_TYPE, "`line`: 'x'"),
        ("route", {"line": "0,0,100001,0"}, Refusal.TOO_LARGE, "`line`: 100 km, over 100 km"),
        ("route", {"line": ",".join(["0,0,1,1"] * 5001)}, Refusal.TOO_LARGE, "`line`: 10002 places"),
        ("route", {**LINE, "mass": "0"}, Refusal.OUT_OF_RANGE, "`mass`: 0 is not positive"),
        ("route", {**LINE, "mass": "1000001"}, Refusal.OUT_OF_RANGE, "`mass`: 1e+06 is over 1e+06"),
        ("route", {**LINE, "efficiency": "1.01"}, Refusal.OUT_OF_RANGE, "`efficiency`: 1.01 is over 1"),
        ("route", {**LINE, "rotating": "0.9"}, Refusal.OUT_OF_RANGE, "`rotating`: 0.9 is not between 1 and 2"),
        ("route", {**LINE, "power": "inf"}, Refusal.NOT_FINITE, "`power`: inf"),
        ("route", {**LINE, "machine": "Ox"}, Refusal.OUT_OF_RANGE, "`machine`: 'Ox' is no name; kinds are loader"),
        ("route", {**LINE, "stops": "often"}, Refusal.OUT_OF_RANGE, "`stops`: 'often'"),
        ("route", {**LINE, "step": "0.5"}, Refusal.OUT_OF_RANGE, "`step`: 0.5 m is not between 1"),
        ("route", {"line": "0,0,20000,0", "step": "1"}, Refusal.TOO_LARGE, "`step`: 20000 m in steps of 1 m"),
        ("route", {**LINE, "unknown": "0"}, Refusal.OUT_OF_RANGE, "`unknown`: a resistance of 0"),
        ("route", {**LINE, "unknown": "free"}, Refusal.WRONG_TYPE, "`unknown`: 'free'"),
        ("route", {**LINE, "colour": "red"}, Refusal.UNKNOWN_PARAMETER, "`colour`"),
        ("way", {"from": "0,0"}, Refusal.MISSING_FIELD, "`to` is missing"),
        ("way", {"from": "0,0", "to": "0,0"}, Refusal.OUT_OF_RANGE, "`to`: the same place"),
        ("way", {"from": "0,0,1,1", "to": "0,0"}, Refusal.OUT_OF_RANGE, "`from`: 2 places"),
        ("way", {**ENDS, "cost": "money"}, Refusal.OUT_OF_RANGE, "`cost`: 'money'"),
        ("way", {**ENDS, "max_grade": "0"}, Refusal.OUT_OF_RANGE, "`max_grade`: 0 is not above 0"),
        ("way", {**ENDS, "margin": "-1"}, Refusal.OUT_OF_RANGE, "`margin`: -1 m"),
        ("way", {**ENDS, "avoid": "1"}, Refusal.OUT_OF_RANGE, "`avoid`: 1 numbers"),
    ],
)
def test_what_no_map_can_answer_is_refused_by_name(name, parameters, reason, said):
    with pytest.raises(QueryError) as caught:
        parse_query(name, parameters)
    assert caught.value.reason == reason
    assert said in str(caught.value)
