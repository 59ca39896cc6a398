"""Impossible queries, a row each: refused with reason and parameter before any map is read."""

import pytest

from protocol.errors import QueryError, Refusal
from protocol.machine.readings import MAX_STAMP_NS
from protocol.queries.places import MAX_CORNERS, MAX_PLACES
from protocol.queries.requests import parse_query

REFUSED = [
    # --- points, regions, histories and their options
    ("weather", {}, Refusal.UNKNOWN_QUERY, "weather"),
    ("point", {"x": "1", "y": "2", "colour": "red"}, Refusal.UNKNOWN_PARAMETER, "colour"),
    ("point", {"x": "1"}, Refusal.MISSING_FIELD, "`y`"),
    ("point", {"x": "here", "y": "2"}, Refusal.WRONG_TYPE, "`x`"),
    ("point", {"x": "nan", "y": "2"}, Refusal.NOT_FINITE, "`x`"),
    ("point", {"x": "1e16", "y": "0"}, Refusal.NOT_FINITE, "`x`"),
    ("history", {"x": "0", "y": "0", "as_of": "1"}, Refusal.UNKNOWN_PARAMETER, "as_of"),
    ("changes", {"wait": "1"}, Refusal.UNKNOWN_PARAMETER, "wait"),
    ("changes", {"after": "-1"}, Refusal.OUT_OF_RANGE, "after"),
    ("point", {"x": "1", "y": "2", "as_of": "1.5"}, Refusal.WRONG_TYPE, "as_of"),
    ("point", {"x": "1", "y": "2", "as_of": "-1"}, Refusal.WRONG_TYPE, "as_of"),
    ("point", {"x": "1", "y": "2", "as_of": str(MAX_STAMP_NS + 1)}, Refusal.OUT_OF_RANGE, "as_of"),
    ("point", {"x": "1", "y": "2", "as_of": "9" * 5000}, Refusal.OUT_OF_RANGE, "as_of"),
    ("region", {"bounds": "0,0,1,1", "minus": "0"}, Refusal.OUT_OF_RANGE, "minus"),
    ("history", {"x": "1", "y": "2", "from": "2", "to": "1"}, Refusal.OUT_OF_RANGE, "`from`"),
    ("history", {"x": "1", "y": "2", "to": "0"}, Refusal.OUT_OF_RANGE, "`to`"),
    ("history", {"x": "1", "y": "2", "span": "0.5"}, Refusal.OUT_OF_RANGE, "`span`"),
    ("region", {}, Refusal.MISSING_FIELD, "bounds"),
    ("region", {"bounds": "0,0,nan,1"}, Refusal.NOT_FINITE, "bounds"),
    ("region", {"bounds": "1,0,0,1"}, Refusal.OUT_OF_RANGE, "west"),
    ("info", {"after": "soon"}, Refusal.WRONG_TYPE, "after"),
    ("info", {"after": "1", "wait": "61"}, Refusal.OUT_OF_RANGE, "wait"),
    # --- lists of places, and outlines
    ("points", {}, Refusal.MISSING_FIELD, "`places` is missing"),
    ("points", {"places": "1,2,3"}, Refusal.OUT_OF_RANGE, "`places`: 3 numbers"),
    ("points", {"places": "1,nan"}, Refusal.NOT_FINITE, "`places`"),
    ("points", {"places": ",".join(["1"] * (2 * MAX_PLACES + 2))}, Refusal.TOO_LARGE, "10001 places, over 10000"),
    ("region", {"polygon": "0,0,1,1"}, Refusal.OUT_OF_RANGE, "2 corners; an outline has at least three"),
    (
        "region",
        {"polygon": "0,0,9,9,9,0,0,9"},
        Refusal.OUT_OF_RANGE,
        "sides from corners 1 and 3 on cross each other",
    ),
    ("region", {"polygon": "0,0,9,0,5,0,5,5"}, Refusal.OUT_OF_RANGE, "turns back on itself at corner 2"),
    ("region", {"polygon": "0,0,9,0,9,0,5,5"}, Refusal.OUT_OF_RANGE, "corners 2 and 3 are the same"),
    ("region", {"polygon": "0,0,9,0,9,5,0,0"}, Refusal.OUT_OF_RANGE, "corners 4 and 1 are the same"),
    ("region", {"polygon": "1,2," * MAX_CORNERS + "1,2"}, Refusal.TOO_LARGE, f"over {MAX_CORNERS}"),
    ("region", {"polygon": "0,0,9,0,9,5", "bounds": "0,0,1,1"}, Refusal.OUT_OF_RANGE, "given with `bounds`"),
    ("region", {"bounds": "0,0,1,1", "resolution": "0"}, Refusal.OUT_OF_RANGE, "`resolution`: 0 m"),
    ("region", {"bounds": "0,0,1,1", "resolution": "2000"}, Refusal.OUT_OF_RANGE, "`resolution`: 2000 m"),
    ("route", {"line": "0,0,9,9", "machine": "truck-1", "efficiency": "2"}, Refusal.OUT_OF_RANGE, "`efficiency`"),
    # --- routes and ways
    ("route", {}, Refusal.MISSING_FIELD, "`line` is missing"),
    ("route", {"line": "1,2"}, Refusal.OUT_OF_RANGE, "`line`: 1 places"),
    ("route", {"line": "1,2,1,2"}, Refusal.OUT_OF_RANGE, "`line`: places 1 and 2 are the same"),
    ("route", {"line": "1,2,x,4"}, Refusal.WRONG_TYPE, "`line`: 'x'"),
    ("route", {"line": "0,0,100001,0"}, Refusal.TOO_LARGE, "`line`: 100 km, over 100 km"),
    ("route", {"line": ",".join(["0,0,1,1"] * 5001)}, Refusal.TOO_LARGE, "`line`: 10002 places"),
    ("route", {"line": "0,0,30,40", "mass": "0"}, Refusal.OUT_OF_RANGE, "`mass`: 0 is not positive"),
    ("route", {"line": "0,0,30,40", "mass": "1000001"}, Refusal.OUT_OF_RANGE, "`mass`: 1e+06 is over 1e+06"),
    ("route", {"line": "0,0,30,40", "efficiency": "1.01"}, Refusal.OUT_OF_RANGE, "`efficiency`: 1.01 is over 1"),
    ("route", {"line": "0,0,30,40", "rotating": "0.9"}, Refusal.OUT_OF_RANGE, "`rotating`: 0.9 is not between 1 and 2"),
    (
        "route",
        {"line": "0,0,30,40", "machine": "Ox"},
        Refusal.OUT_OF_RANGE,
        "`machine`: 'Ox' is no name; kinds are loader",
    ),
    ("route", {"line": "0,0,30,40", "stops": "often"}, Refusal.OUT_OF_RANGE, "`stops`: 'often'"),
    ("route", {"line": "0,0,30,40", "step": "0.5"}, Refusal.OUT_OF_RANGE, "`step`: 0.5 m is not between 1"),
    ("route", {"line": "0,0,20000,0", "step": "1"}, Refusal.TOO_LARGE, "`step`: 20000 m in steps of 1 m"),
    ("route", {"line": "0,0,30,40", "unknown": "0"}, Refusal.OUT_OF_RANGE, "`unknown`: a resistance of 0"),
    ("route", {"line": "0,0,30,40", "unknown": "free"}, Refusal.WRONG_TYPE, "`unknown`: 'free'"),
    ("way", {"from": "0,0"}, Refusal.MISSING_FIELD, "`to` is missing"),
    ("way", {"from": "0,0", "to": "0,0"}, Refusal.OUT_OF_RANGE, "`to`: the same place"),
    ("way", {"from": "0,0", "to": "30,40", "cost": "money"}, Refusal.OUT_OF_RANGE, "`cost`: 'money'"),
    ("way", {"from": "0,0", "to": "30,40", "max_grade": "0"}, Refusal.OUT_OF_RANGE, "`max_grade`: 0 is not above 0"),
    ("way", {"from": "0,0", "to": "30,40", "margin": "-1"}, Refusal.OUT_OF_RANGE, "`margin`: -1 m"),
    ("way", {"from": "0,0", "to": "30,40", "avoid": "1"}, Refusal.OUT_OF_RANGE, "`avoid`: 1 numbers"),
]


@pytest.mark.parametrize(("name", "parameters", "reason", "words"), REFUSED)
def test_what_no_map_can_answer_is_refused_by_name(name, parameters, reason, words):
    with pytest.raises(QueryError) as caught:
        parse_query(name, parameters)
    assert caught.value.reason == reason
    assert words in str(caught.value)
