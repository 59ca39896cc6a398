"""Lists of places, outlines, routes, ways: round trips, and refusals by name."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.errors import QueryError
from protocol.queries.parameters import selector_of, split_selector
from protocol.queries.places import MAX_CORNERS, MAX_PLACES, check_outline
from protocol.queries.requests import PointsQuery, RegionQuery, parse_query
from protocol.queries.route_requests import REFUSE, TIME, RouteQuery, WayQuery
from protocol.queries.routing import MACHINES, NamedMachine, RouteMachine, machine_of
from protocol.site.geometry import Bounds

PLACE = st.tuples(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6))
SQUARE = ((0.0, 0.0), (10.0, 0.0), (10.0, 10.0), (0.0, 10.0))


def round_trip(query):
    return parse_query(query.name, split_selector(selector_of(query.parameters())))


@given(st.lists(PLACE, min_size=1, max_size=30).map(tuple), st.none() | st.integers(1, 10**18))
def test_points_are_asked_as_they_were_meant(places, as_of_ns):
    query = PointsQuery(places, ("resistance",), after=3, wait_s=4.0, as_of_ns=as_of_ns)
    assert round_trip(query) == query


@given(st.integers(3, MAX_CORNERS), st.floats(0.1, 1e4), st.none() | st.floats(0.5, 1000))
def test_a_ring_is_an_outline_in_either_direction(count, radius_m, resolution_m):
    angles = [2 * math.pi * i / count for i in range(count)]
    ring = tuple((radius_m * math.cos(angle), radius_m * math.sin(angle)) for angle in angles)
    for area in (ring, ring[::-1]):
        query = RegionQuery(area, resolution_m=resolution_m)
        assert round_trip(query) == query
        assert query.bounds.east_m == pytest.approx(radius_m)


def test_sides_that_cross_are_found_wherever_they_are():
    """Against a plain check of all pairs, on random outlines."""
    draw = np.random.default_rng(5)
    crossed = 0
    for _ in range(300):
        corners = tuple(map(tuple, draw.integers(0, 6, (draw.integers(3, 8), 2)).astype(float).tolist()))
        try:
            check_outline("polygon", corners)
            is_refused = False
        except QueryError:
            is_refused = True
        assert is_refused == (not is_simple(corners)), corners
        crossed += is_refused
    assert 100 < crossed < 290


def is_simple(corners) -> bool:
    n = len(corners)
    sides = [(corners[i], corners[(i + 1) % n]) for i in range(n)]
    if any(a == b for a, b in sides):
        return False
    for i in range(n):
        for j in range(i + 1, n):
            common = set(sides[i]) & set(sides[j])
            if (j == i + 1 or (i == 0 and j == n - 1)) and n > 2:
                (a, b), (c, d) = sides[i], sides[j]
                shared = b if j == i + 1 else a
                one, other = (a if shared == b else b), (d if shared == c else c)
                if turn(one, shared, other) == 0 and dot(one, shared, other) > 0:
                    return False
                if len(common) > 1:
                    return False
            elif touch(*sides[i], *sides[j]):
                return False
    return True


def turn(a, b, c) -> float:
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def dot(a, b, c) -> float:
    return (a[0] - b[0]) * (c[0] - b[0]) + (a[1] - b[1]) * (c[1] - b[1])


def touch(a, b, c, d) -> bool:
    def on(p, q, r) -> bool:
        return turn(p, q, r) == 0 and all(min(p[k], q[k]) <= r[k] <= max(p[k], q[k]) for k in (0, 1))

    apart = turn(a, b, c) * turn(a, b, d) < 0 and turn(c, d, a) * turn(c, d, b) < 0
    return apart or on(a, b, c) or on(a, b, d) or on(c, d, a) or on(c, d, b)


def test_no_places_and_no_numbers_are_refused_where_a_query_is_made():
    with pytest.raises(QueryError, match="`places`: there is none"):
        PointsQuery(())
    with pytest.raises(QueryError, match="corner that is no number"):
        RegionQuery(((0.0, 0.0), (math.nan, 1.0), (2.0, 2.0)))
    assert RegionQuery(Bounds(0, 0, 1, 1)).bounds == Bounds(0, 0, 1, 1)
    assert RegionQuery(SQUARE).bounds == Bounds(0, 0, 10, 10)


def test_a_machine_is_a_kind_or_a_name_and_keeps_what_is_given():
    named = RouteQuery(SQUARE[:2], machine=NamedMachine("truck-1", (("efficiency", 0.4), ("mass_kg", 3e4))))
    assert round_trip(named) == named
    assert named.parameters()["machine"] == "truck-1"
    assert machine_of("truck") is MACHINES["truck"]
    assert machine_of("truck-1") == NamedMachine("truck-1")
    with pytest.raises(ValueError, match="mass_kg"):
        NamedMachine("truck-1", (("mass_kg", -1.0),))


@pytest.mark.parametrize(
    "query",
    [
        RouteQuery(((0.1, -0.2), (1e5 / 3, 7.0), (0.0, 0.0))),
        RouteQuery(
            ((0.0, 0.0), (1.0, 1.0)),
            machine=MACHINES["truck"],
            stops=(False, True),
            step_m=1.5,
            unknown=REFUSE,
            after=3,
        ),
        WayQuery((0.0, 0.0), (30.0, 40.0)),
        WayQuery(
            (0.0, 0.0),
            (3.0, 4.0),
            TIME,
            0.1,
            5.0,
            ((1.0, 2.0),),
            stops=(False, False),
            step_m=9.0,
            unknown=0.05,
            as_of_ns=17,
        ),
    ],
)
def test_a_route_or_way_is_asked_as_it_was_meant(query):
    assert round_trip(query) == query


def test_a_machine_is_a_kind_with_values_of_its_own():
    query = parse_query("route", {"line": "0,0,30,40", "machine": "truck", "mass": "30000"})
    assert isinstance(query, RouteQuery)
    assert query.machine == RouteMachine(30_000.0, power_w=240_000.0, rotating=1.1)
    assert parse_query("route", {"line": "0,0,30,40"}) == RouteQuery(((0.0, 0.0), (30.0, 40.0)))


def test_as_many_places_as_a_line_may_have():
    places = tuple((i / 3, 0.1) for i in range(MAX_PLACES))
    query = RouteQuery(places)
    assert parse_query("route", query.parameters()) == query
