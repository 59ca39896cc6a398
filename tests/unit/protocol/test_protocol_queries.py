import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.codec import pack
from protocol.errors import MessageError, QueryError, Refusal
from protocol.geometry import MAX_CELLS, Bounds
from protocol.queries import (
    Freshness,
    InfoQuery,
    PointAnswer,
    PointQuery,
    Region,
    RegionQuery,
    check_size,
    decode_error,
    decode_info,
    decode_point,
    decode_region,
    encode_error,
    encode_info,
    encode_point,
    encode_query,
    encode_region,
    parse_query,
)

positions = st.floats(-1e15, 1e15)
layers = st.lists(st.sampled_from(["resistance", "grade_east", "age_s"]), max_size=3).map(tuple)
freshness = st.just(Freshness()) | st.builds(Freshness, st.integers(1, 10**15), st.floats(0, 60))


@st.composite
def bounds(draw):
    west, east = sorted(draw(st.lists(positions, min_size=2, max_size=2, unique=True)))
    south, north = sorted(draw(st.lists(positions, min_size=2, max_size=2, unique=True)))
    return Bounds(west, south, east, north)


@given(
    st.builds(PointQuery, positions, positions, layers, freshness)
    | st.builds(RegionQuery, bounds(), layers, freshness)
    | st.builds(InfoQuery, freshness)
)
def test_query_round_trip(query):
    assert parse_query(query.name, encode_query(query)) == query


def test_bounds_of_an_answer_can_be_asked_again():
    region = Region(np.array([0.5, 1.5]), np.array([-0.5]), 1.0, {}, 0, 1)  # its bounds are numpy's numbers
    query = RegionQuery(region.bounds)
    assert parse_query("region", encode_query(query)).bounds == Bounds(0.0, -1.0, 2.0, 0.0)
    point = PointQuery(np.float64(1.5), np.float32(0.5))
    assert parse_query("point", encode_query(point)) == PointQuery(1.5, 0.5)


@pytest.mark.parametrize(
    ("name", "parameters", "reason", "words"),
    [
        ("route", {}, Refusal.UNKNOWN_QUERY, "route"),
        ("point", {"x": "1", "y": "2", "colour": "red"}, Refusal.UNKNOWN_PARAMETER, "colour"),
        ("info", {"layers": "resistance"}, Refusal.UNKNOWN_PARAMETER, "layers"),
        ("region", {"bounds": "0,0,1,1", "x": "1"}, Refusal.UNKNOWN_PARAMETER, "`x`"),
        ("point", {"x": "1"}, Refusal.MISSING_FIELD, "`y`"),
        ("point", {"x": "here", "y": "2"}, Refusal.WRONG_TYPE, "`x`"),
        ("point", {"x": "", "y": "2"}, Refusal.WRONG_TYPE, "`x`"),
        ("point", {"x": "nan", "y": "2"}, Refusal.NOT_FINITE, "`x`"),
        ("point", {"x": "1", "y": "-inf"}, Refusal.NOT_FINITE, "`y`"),
        ("point", {"x": "1e16", "y": "0"}, Refusal.NOT_FINITE, "`x`"),
        ("region", {}, Refusal.MISSING_FIELD, "bounds"),
        ("region", {"bounds": "0,0,1"}, Refusal.MISSING_FIELD, "bounds"),
        ("region", {"bounds": "0,0,1,1,1"}, Refusal.MISSING_FIELD, "bounds"),
        ("region", {"bounds": "0,0,nan,1"}, Refusal.NOT_FINITE, "bounds"),
        ("region", {"bounds": "1,0,0,1"}, Refusal.OUT_OF_RANGE, "west"),
        ("region", {"bounds": "0,1,1,1"}, Refusal.OUT_OF_RANGE, "south"),
        ("info", {"after": "-1"}, Refusal.OUT_OF_RANGE, "after"),
        ("info", {"after": "1.5"}, Refusal.OUT_OF_RANGE, "after"),
        ("info", {"after": "soon"}, Refusal.WRONG_TYPE, "after"),
        ("info", {"after": "1", "wait": "61"}, Refusal.OUT_OF_RANGE, "wait"),
        ("info", {"after": "1", "wait": "-1"}, Refusal.OUT_OF_RANGE, "wait"),
    ],
)
def test_bad_query_is_refused_by_name(name, parameters, reason, words):
    with pytest.raises(QueryError) as caught:
        parse_query(name, parameters)
    assert caught.value.reason == reason
    assert words in str(caught.value)


@given(
    st.sampled_from(["point", "region", "info", "x"]),
    st.dictionaries(st.sampled_from(["x", "y", "bounds", "layers", "after", "wait"]) | st.text(max_size=3), st.text()),
)
def test_any_parameters(name, parameters):
    try:
        parse_query(name, parameters)
    except QueryError as error:
        assert error.reason in set(Refusal)  # noqa: PT017 - any outcome but another error is right


def test_region_too_large_is_refused():
    check_size(4000, MAX_CELLS // 4000)
    with pytest.raises(QueryError, match="4001") as caught:
        check_size(4001, MAX_CELLS // 4000)
    assert caught.value.reason == Refusal.TOO_LARGE


values = st.floats(width=32)


@given(st.integers(1, 5), st.integers(1, 5), st.integers(-1000, 1000), st.data())
def test_region_round_trip(columns, rows, west, data):
    flat = data.draw(st.lists(values, min_size=rows * columns, max_size=rows * columns))
    table = np.array(flat, np.float32).reshape(rows, columns)
    x_m, y_m = (west + np.arange(columns) + 0.5) * 0.5, (np.arange(rows) + 0.5) * 0.5
    region = Region(x_m, y_m, 0.5, {"resistance": table}, 7, 8)
    got = decode_region(encode_region(region))
    assert got["resistance"].tobytes() == table.tobytes()
    assert (got.x_m == region.x_m).all()
    assert (got.y_m == region.y_m).all()
    assert (got.cell_m, got.merged, got.stamp_ns, got.bounds) == (0.5, 7, 8, region.bounds)


def test_region_may_hold_layers_that_are_no_float32():
    table = np.arange(6, dtype=np.int64).reshape(3, 2).T  # nor in one piece
    region = Region(np.arange(3) + 0.5, np.arange(2) + 0.5, 1.0, {"visits": table}, 0, 1)
    assert decode_region(encode_region(region))["visits"].tolist() == table.tolist()


def region_table(**fields) -> bytes:
    base = {"west_m": 0.0, "south_m": 0.0, "cell_m": 1.0, "columns": 2, "rows": 1, "layers": {"a": bytes(8)}}
    return pack({**base, "merged": 1, "stamp_ns": 1, **fields})


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"layers": {"a": bytes(7)}}, Refusal.COLUMN_LENGTH),
        ({"layers": {"a": bytes(4)}}, Refusal.COLUMN_LENGTH),
        ({"layers": {"a": "text"}}, Refusal.WRONG_TYPE),
        ({"layers": {b"a": bytes(8)}}, Refusal.COLUMN_LENGTH),
        ({"columns": -2, "rows": -1}, Refusal.OUT_OF_RANGE),
        ({"columns": 10**12}, Refusal.OUT_OF_RANGE),
        ({"cell_m": 0.0}, Refusal.OUT_OF_RANGE),
        ({"cell_m": 1e300}, Refusal.OUT_OF_RANGE),
        ({"west_m": math.nan}, Refusal.NOT_FINITE),
    ],
)
def test_malformed_region_is_refused(fields, reason):
    with pytest.raises(MessageError) as caught:
        decode_region(region_table(**fields))
    assert caught.value.reason is reason


def test_point_keeps_unknown_as_nan():
    got = decode_point(encode_point(PointAnswer(0.5, -0.5, {"resistance": math.nan, "visits": 3}, 7, 8)))
    assert math.isnan(got.values["resistance"])
    assert got.values["visits"] == 3.0
    assert (got.x_m, got.y_m, got.merged, got.stamp_ns) == (0.5, -0.5, 7, 8)


def test_point_whose_values_are_no_numbers_is_refused():
    table = {"x_m": 0.5, "y_m": 0.5, "values": {"resistance": "high"}, "merged": 1, "stamp_ns": 1}
    with pytest.raises(MessageError, match=r"values\.resistance"):
        decode_point(pack(table))


def test_info_and_error_round_trip():
    info = {"journalled": 5, "refused": {"gap": 2}, "machines": ["a"]}
    assert decode_info(encode_info(info)) == info
    error = decode_error(encode_error(QueryError(Refusal.UNKNOWN_LAYER, "layer `x` is not known")))
    assert (error.reason, str(error)) == ("unknown_layer", "layer `x` is not known")
