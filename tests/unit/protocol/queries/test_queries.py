import math
import re
from dataclasses import asdict, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.errors import MessageError, QueryError, Refusal
from protocol.machine.readings import MAX_STAMP_NS
from protocol.queries import answer_codec as codec
from protocol.queries import answers
from protocol.queries.commands import (
    MOST_OFF,
    AcceptCommand,
    CalibrateCommand,
    TrustCommand,
    encode_command,
    parse_command,
)
from protocol.queries.parameters import MAX_TEXT, quoted, selector_of, split_selector
from protocol.queries.requests import (
    AliveQuery,
    ChangesQuery,
    Freshness,
    HistoryQuery,
    InfoQuery,
    MachinesQuery,
    PointQuery,
    RegionQuery,
    When,
    check_size,
    encode_query,
    parse_query,
)
from protocol.site.geometry import MAX_CELLS, Bounds
from protocol.site.site_config import KnownGround, SiteConfig
from protocol.wire.codec import pack
from tests.unit.records import STORE, site_info, version

positions = st.floats(-1e15, 1e15)
layers = st.lists(st.sampled_from(["resistance", "grade_east", "age_s"]), max_size=3).map(tuple)
stamps = st.none() | st.integers(1, MAX_STAMP_NS)
when = st.builds(When, stamps, stamps)
freshness = st.just(Freshness()) | st.builds(Freshness, st.integers(1, 10**15), st.floats(0, 60))


@st.composite
def bounds(draw):
    west, east = sorted(draw(st.lists(positions, min_size=2, max_size=2, unique=True)))
    south, north = sorted(draw(st.lists(positions, min_size=2, max_size=2, unique=True)))
    return Bounds(west, south, east, north)


@st.composite
def histories(draw):
    times = draw(st.just((None, None)) | st.tuples(stamps, stamps))
    if None not in times:
        times = tuple(sorted(times))
    span_s = draw(st.none() | st.floats(1, 1e9))
    return HistoryQuery(draw(positions), draw(positions), draw(layers), *times, span_s, draw(freshness))


@given(
    st.builds(PointQuery, positions, positions, layers, freshness, when)
    | st.builds(RegionQuery, bounds(), layers, freshness, when)
    | histories()
    | st.builds(MachinesQuery, freshness)
    | st.builds(ChangesQuery, st.integers(0, 10**15))
    | st.builds(InfoQuery, freshness)
    | st.builds(AliveQuery)
)
def test_query_round_trip(query):
    assert parse_query(query.name, split_selector(selector_of(encode_query(query)))) == query


def test_a_stamp_is_read_to_the_last_digit():
    query = parse_query("point", {"x": "0", "y": "0", "as_of": "1750000000000000001", "minus": "1750000000000000003"})
    assert query.when == When(1750000000000000001, 1750000000000000003)


@given(st.text(st.characters(exclude_categories=("C", "Z")) | st.just(" "), max_size=MAX_TEXT), st.floats(0, 60))
def test_a_command_round_trips_whatever_its_reason(text, wait_s):
    for trusted in (True, None, False):
        command = TrustCommand("loader-1", trusted, text.strip() or "why", wait_s)
        assert parse_command("trust", split_selector(selector_of(encode_command(command)))) == command


def test_a_command_without_reason_and_wait_is_complete():
    assert parse_command("trust", {"machine": "a", "trusted": "auto"}) == TrustCommand("a", None, "", 30.0)
    assert parse_command("trust", {"machine": "a", "trusted": "yes"}).trusted is True


@pytest.mark.parametrize(
    ("parameters", "reason", "words"),
    [
        ({"machine": "a", "trusted": "yes", "colour": "red"}, Refusal.UNKNOWN_PARAMETER, "colour"),
        ({"trusted": "yes"}, Refusal.MISSING_FIELD, "`machine`"),
        ({"machine": "a"}, Refusal.MISSING_FIELD, "`trusted`"),
        ({"machine": "*", "trusted": "yes"}, Refusal.OUT_OF_RANGE, "`machine`"),
        ({"machine": "a", "trusted": "maybe"}, Refusal.OUT_OF_RANGE, "yes, no, auto"),
        ({"machine": "a", "trusted": "no"}, Refusal.MISSING_FIELD, "`reason`"),
        ({"machine": "a", "trusted": "no", "reason": "%20"}, Refusal.MISSING_FIELD, "`reason`"),
        ({"machine": "a", "trusted": "no", "reason": "a%0Ab"}, Refusal.OUT_OF_RANGE, "`reason`"),
        ({"machine": "a", "trusted": "no", "reason": "x" * (MAX_TEXT + 1)}, Refusal.OUT_OF_RANGE, "`reason`"),
        ({"machine": "a", "trusted": "yes", "wait": "61"}, Refusal.OUT_OF_RANGE, "`wait`"),
        ({"machine": "a", "trusted": "yes", "wait": "-1"}, Refusal.OUT_OF_RANGE, "`wait`"),
        ({"machine": "a", "trusted": "yes", "wait": "long"}, Refusal.WRONG_TYPE, "`wait`"),
    ],
)
def test_bad_command_is_refused_by_name(parameters, reason, words):
    with pytest.raises(QueryError, match="command `shutdown` is not known; known: trust, accept"):
        parse_command("shutdown", {})
    with pytest.raises(QueryError) as caught:
        parse_command("trust", parameters)
    assert caught.value.reason == reason
    assert words in str(caught.value)


def test_a_store_is_accepted_by_its_id_and_with_a_reason():
    command = AcceptCommand(STORE, "disk died; 50 % = lost")
    assert parse_command("accept", split_selector(selector_of(encode_command(command)))) == command
    for parameters, reason, words in (
        ({"reason": "died"}, Refusal.MISSING_FIELD, "`store`"),
        ({"store": STORE}, Refusal.MISSING_FIELD, "`reason`"),
        ({"store": STORE.upper(), "reason": "died"}, Refusal.OUT_OF_RANGE, "16 hex digits"),
        ({"store": STORE, "reason": "died", "machine": "a"}, Refusal.UNKNOWN_PARAMETER, "machine"),
    ):
        with pytest.raises(QueryError, match=words) as caught:
            parse_command("accept", parameters)
        assert caught.value.reason == reason


def test_what_divides_parameters_survives_in_a_text():
    assert quoted("a;b=c %&?#/é") == "a%3Bb%3Dc%20%25%26%3F%23%2F%C3%A9"
    assert split_selector("a=1;b=x=y;c;;d=") == {"a": "1", "b": "x=y", "c": "", "d": ""}


def test_bounds_of_an_answer_can_be_asked_again():
    region = answers.Region(
        np.array([0.5, 1.5]), np.array([-0.5]), 1.0, {}, version(), 1
    )  # its bounds are numpy's numbers
    query = RegionQuery(region.bounds)
    assert parse_query("region", encode_query(query)).bounds == Bounds(0.0, -1.0, 2.0, 0.0)
    point = PointQuery(np.float64(1.5), np.float32(0.5))
    assert parse_query("point", encode_query(point)) == PointQuery(1.5, 0.5)


@given(
    st.builds(CalibrateCommand, wait_s=st.floats(0, 60))
    | st.builds(CalibrateCommand, st.just("loader-1"), auto=st.just(True), wait_s=st.floats(0, 60))
    | st.builds(
        CalibrateCommand,
        st.just("loader-1"),
        st.floats(-0.5, 0.5),
        *[st.none() | st.floats(-0.5, 0.5)] * 2,
        reason=st.just("levelled; 12 May = today"),
    )
)
def test_calibrate_round_trip(command):
    assert parse_command("calibrate", split_selector(selector_of(encode_command(command)))) == command


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({"machine": "a b", "zero": "0.1"}, "'a b' is not a name"),
        ({"machine": "a"}, "`machine` comes with one of"),
        ({"zero": "0.1", "reason": "x"}, "`machine` comes with one of"),
        ({"auto": "yes"}, "`machine` comes with one of"),
        ({"machine": "a", "auto": "maybe"}, "none of yes, no"),
        ({"machine": "a", "zero": "0.1"}, "`reason` is missing"),
        ({"machine": "a", "zero": "0.1", "auto": "yes", "reason": "x"}, "parameter `auto`"),
        ({"machine": "a", "zero": "0.51", "reason": "x"}, "`zero`: 0.51 is not between -0.5 and 0.5"),
        ({"machine": "a", "scale": "-0.91", "reason": "x"}, "`scale`: -0.91 is not between -0.9 and 0.9"),
        ({"machine": "a", "across": "nan", "reason": "x"}, "`across`"),
        ({"machine": "a", "gain": "1", "reason": "x"}, "`gain` is not known"),
        ({"wait": "61"}, "`wait`"),
    ],
)
def test_a_wrong_calibrate_is_refused_by_name(parameters, words):
    with pytest.raises(QueryError, match=re.escape(words)):
        parse_command(
            "calibrate", {name: quoted(value) if name == "reason" else value for name, value in parameters.items()}
        )
    assert MOST_OFF == {"zero": 0.5, "scale": 0.9, "across": 0.5}, "as docs/protocol.md says"


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
    region = answers.Region(x_m, y_m, 0.5, {"resistance": table}, version(7), 8)
    got = codec.decode_region(codec.encode_region(region))
    assert got["resistance"].tobytes() == table.tobytes()
    assert (got.x_m == region.x_m).all()
    assert (got.y_m == region.y_m).all()
    assert (got.cell_m, got.merged, got.stamp_ns, got.bounds) == (0.5, 7, 8, region.bounds)


def test_region_may_hold_layers_that_are_no_float32():
    table = np.arange(6, dtype=np.int64).reshape(3, 2).T  # nor in one piece
    region = answers.Region(np.arange(3) + 0.5, np.arange(2) + 0.5, 1.0, {"visits": table}, version(), 1)
    assert codec.decode_region(codec.encode_region(region))["visits"].tolist() == table.tolist()


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
        codec.decode_region(region_table(**fields))
    assert caught.value.reason is reason


def test_point_keeps_unknown_as_nan():
    answer = answers.PointAnswer(0.5, -0.5, {"resistance": math.nan, "visits": 3}, version(7), 8)
    got = codec.decode_point(codec.encode_point(answer))
    assert math.isnan(got.values["resistance"])
    assert got.values["visits"] == 3.0
    assert (got.x_m, got.y_m, got.merged, got.stamp_ns) == (0.5, -0.5, 7, 8)


def test_point_whose_values_are_no_numbers_is_refused():
    table = {"x_m": 0.5, "y_m": 0.5, "values": {"resistance": "high"}, "merged": 1, "stamp_ns": 1}
    with pytest.raises(MessageError, match=r"values\.resistance"):
        codec.decode_point(pack(table))


def test_history_round_trips_and_keeps_unknown_as_nan():
    spans = (
        answers.HistorySpan(10, 19, {"resistance": math.nan, "visits": 3}),
        answers.HistorySpan(30, 39, {"resistance": 0.5, "visits": 1.0}),
    )
    got = codec.decode_history(codec.encode_history(answers.HistoryAnswer(0.5, -0.5, spans, version(7), 8)))
    assert (got.x_m, got.y_m, got.merged, got.stamp_ns) == (0.5, -0.5, 7, 8)
    assert [(span.first_ns, span.last_ns) for span in got.spans] == [(10, 19), (30, 39)]
    assert math.isnan(got.spans[0].values["resistance"])
    assert got.spans[1] == spans[1]


@pytest.mark.parametrize(
    ("spans", "words"),
    [
        ([{"first_ns": 1, "values": {}}], "last_ns"),
        ([{"first_ns": 1, "last_ns": 2}], "values"),
        ([{"first_ns": 1, "last_ns": 2, "values": {"a": "high"}}], r"values\.a"),
        (["span"], r"spans\[0\]: map expected"),
        ({}, "spans: list expected"),
    ],
)
def test_malformed_history_is_refused(spans, words):
    with pytest.raises(MessageError, match=words):
        codec.decode_history(
            pack({"x_m": 0.5, "y_m": 0.5, "spans": spans, "store": STORE, "merged": 1, "fact": 0, "stamp_ns": 1})
        )


MACHINE = answers.MachineState("a", True, "", "", 0, False, ("gain",), {"shift_m": 1.5}, 1, 7, 0, 5, 2)
CHANGE = answers.GroundChange(1, 5, 6, (0.0, 0.0, 1.0, 2.0), 7, 0.25, None, None, None)
SITE = SiteConfig("pit", 48.0, 11.0, known_ground=(KnownGround("pad", 0.01, ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))),))
INFO = answers.MapInfo(
    site=site_info(SITE),
    store=STORE,
    descends=("f" * 16,),
    accepted=(),
    epoch=4,
    replica="synchronous",
    fact=2,
    decided=3,
    corrections=2,
    journalled=5,
    merged=5,
    snapshot=0,
    samples_merged=40,
    samples_too_unsure=2,
    cells=7,
    bounds=(0, -16, 16, 16),
    first_ns=3,
    stamp_ns=9,
    wall_ns=10,
    version="1.0",
    server=answers.ServerProcess("office", 7),
    checkpoints=answers.CheckpointCounts(12, 900_000_000, 1_767_225_600_000_000_000, 1),
    machines={"a": answers.SampleCounts(1, 42, 0, 9, 0)},
    distrusted=("b",),
    shortfalls=("3 journal rows after row 5 are gone",),
    counters={"refused_gap": 2},
    layers=("resistance",),
    boundaries=(0.014, 0.03),
)


def test_records_round_trip():
    machines = answers.MachinesAnswer((MACHINE,), version(5, 2))
    assert codec.decode_machines(codec.encode_machines([MACHINE], machines.version)) == machines
    changes = answers.ChangesAnswer((CHANGE,), version(5, 2))
    assert codec.decode_changes(codec.encode_changes([CHANGE], changes.version)) == changes
    assert codec.decode_change(codec.encode_change(CHANGE)) == CHANGE
    assert codec.decode_info(codec.encode_info(INFO)) == INFO
    assert codec.decode_info(codec.encode_info(replace(INFO, bounds=None))).bounds is None
    answer = answers.TrustAnswer(**vars(MACHINE), store=STORE, merged=3, fact=2)
    assert codec.decode_machine(codec.encode_machine(answer)) == answer


def test_fields_of_a_newer_server_are_ignored():
    newer = codec.encode_changes([{**asdict(CHANGE), "volume_m3": 4.0}], version())
    assert codec.decode_changes(newer).changes == (CHANGE,)
    site = {**asdict(INFO.site), "datum": "WGS84"}
    assert codec.decode_info(codec.encode_info({**asdict(INFO), "site": site, "load": 0.5})) == INFO


def test_info_without_a_field_is_refused():
    for name in asdict(INFO):
        table = {key: value for key, value in asdict(INFO).items() if key != name}
        with pytest.raises(MessageError, match=f"info.{name}: missing"):
            codec.decode_info(codec.encode_info(table))


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"cells": "many"}, "info.cells: int expected, not str"),
        ({"cells": None}, "info.cells: missing"),
        ({"bounds": [1, 2]}, "info.bounds: 4 values expected, not 2"),
        ({"bounds": 7}, "info.bounds: list expected"),
        ({"machines": {"a": {"spools": 1}}}, "info.machines.a.samples: missing"),
        ({"machines": {b"a": {}}}, "info.machines: the name b'a' is no text"),
        ({"counters": {"batches": 1.5}}, "info.counters.batches: int expected"),
        ({"layers": [1]}, r"info.layers\[0\]: str expected"),
        (
            {"site": {**asdict(INFO.site), "known_ground": [{"name": "pad", "c_rr": 2.0, "outline": []}]}},
            "not between 0",
        ),
    ],
)
def test_info_of_other_types_is_refused(values, words):
    with pytest.raises(MessageError, match=words):
        codec.decode_info(codec.encode_info({**asdict(INFO), **values}))


@pytest.mark.parametrize("values", [{"store": "here"}, {"store": None}, {"fact": None}, {"merged": "7"}])
def test_an_answer_without_the_version_of_its_map_is_refused(values):
    fields_of = {"values": {}, "x_m": 0.0, "y_m": 0.0, "store": STORE, "merged": 1, "fact": 0, "stamp_ns": 1}
    assert codec.decode_point(pack(fields_of)).version == version(1)
    with pytest.raises(MessageError, match=next(iter(values))):
        codec.decode_point(pack(fields_of | values))


def test_evidence_is_plain():
    with pytest.raises(MessageError, match="bytes is no plain value"):
        codec.decode_machines(codec.encode_machines([{**asdict(MACHINE), "evidence": {"x": b"1"}}], version()))


@pytest.mark.parametrize("decode", [codec.decode_machines, codec.decode_changes])
def test_a_table_whose_rows_are_no_maps_is_refused(decode):
    name = decode.__name__.removeprefix("decode_")
    with pytest.raises(MessageError, match=rf"{name}\[0\]: dict expected"):
        decode(pack({name: [1, {}]}))


def test_an_event_is_small():
    with pytest.raises(MessageError) as caught:
        codec.decode_change(codec.encode_change({"bounds": [0.0] * 10_000}))
    assert caught.value.reason is Refusal.TOO_LARGE


def test_error_round_trip():
    error = codec.decode_error(codec.encode_error(QueryError(Refusal.UNKNOWN_LAYER, "layer `x` is not known")))
    assert (error.reason, str(error)) == ("unknown_layer", "layer `x` is not known")
