"""Queries for routes: to parameters and back, and what is refused, by name."""

from __future__ import annotations

import pytest

from protocol.queries.parameters import Freshness, selector_of, split_selector
from protocol.queries.places import MAX_PLACES
from protocol.queries.requests import encode_query, parse_query
from protocol.queries.route_requests import REFUSE, TIME, RouteQuery, WayQuery
from protocol.queries.routing import MACHINES, RouteMachine

LINE = {"line": "0,0,30,40"}


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
