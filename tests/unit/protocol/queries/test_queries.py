import math
import re
from dataclasses import asdict

import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.errors import MessageError, QueryError, Refusal
from protocol.machine.readings import MAX_STAMP_NS
from protocol.queries import answer_codec as codec
from protocol.queries import answers
from protocol.queries.commands import MOST_OFF, AcceptCommand, CalibrateCommand, TrustCommand, parse_command
from protocol.queries.parameters import LINE, MAX_TEXT, selector_of, split_selector
from protocol.queries.requests import (
    AliveQuery,
    ChangesQuery,
    HistoryQuery,
    InfoQuery,
    MachinesQuery,
    PointQuery,
    RegionQuery,
    parse_query,
)
from protocol.site.geometry import Bounds
from protocol.site.site_config import KnownGround, SiteConfig
from protocol.wire.fields import pack
from tests.golden import questions
from tests.unit.records import STORE, site_info, version

positions = st.floats(-1e15, 1e15)
layers = st.lists(st.sampled_from(["resistance", "grade_east", "age_s"]), max_size=3).map(tuple)
stamps = st.none() | st.integers(1, MAX_STAMP_NS)
when = {"as_of_ns": stamps, "minus_ns": stamps}
freshness = {"after": st.integers(1, 10**15), "wait_s": st.floats(0, 60)}


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
    return HistoryQuery(draw(positions), draw(positions), draw(layers), *times, span_s, after=draw(freshness["after"]))


@given(
    st.builds(PointQuery, positions, positions, layers, **freshness, **when)
    | st.builds(RegionQuery, bounds(), layers, **freshness, **when)
    | histories()
    | st.builds(MachinesQuery, **freshness)
    | st.builds(ChangesQuery, st.integers(0, 10**15))
    | st.builds(InfoQuery, **freshness)
    | st.builds(AliveQuery)
)
def test_query_round_trip(query):
    assert parse_query(query.name, split_selector(selector_of(query.parameters()))) == query


def test_selectors_do_not_change_by_accident():
    lines = questions.SELECTORS.read_text().splitlines()
    assert questions.selectors() == lines, "if it is meant: PYTHONPATH=. python tests/golden/questions.py"
    for line, asked in zip(lines, (*questions.QUESTIONS, *questions.COMMANDS), strict=True):
        name, _, text = line.partition("?")
        parse = parse_query if asked in questions.QUESTIONS else parse_command
        assert parse(name, split_selector(text)) == asked


@given(st.text(st.characters(exclude_categories=("C", "Z")) | st.just(" "), max_size=MAX_TEXT), st.floats(0, 60))
def test_a_command_round_trips_whatever_its_reason(text, wait_s):
    for trusted in (True, None, False):
        command = TrustCommand("loader-1", trusted, text.strip() or "why", wait_s)
        assert parse_command("trust", split_selector(selector_of(command.parameters()))) == command


@pytest.mark.parametrize(
    ("parameters", "reason", "words"),
    [
        ({"machine": "a", "trusted": "yes", "colour": "red"}, Refusal.UNKNOWN_PARAMETER, "colour"),
        ({"trusted": "yes"}, Refusal.MISSING_FIELD, "`machine`"),
        ({"machine": "a"}, Refusal.MISSING_FIELD, "`trusted`"),
        ({"machine": "a", "trusted": "maybe"}, Refusal.OUT_OF_RANGE, "yes, no, auto"),
        ({"machine": "a", "trusted": "no"}, Refusal.MISSING_FIELD, "`reason`"),
        ({"machine": "a", "trusted": "no", "reason": "a%0Ab"}, Refusal.OUT_OF_RANGE, "`reason`"),
        ({"machine": "a", "trusted": "no", "reason": "x" * (MAX_TEXT + 1)}, Refusal.OUT_OF_RANGE, "`reason`"),
        ({"machine": "a", "trusted": "yes", "wait": "61"}, Refusal.OUT_OF_RANGE, "`wait`"),
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
    assert parse_command("accept", split_selector(selector_of(command.parameters()))) == command
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
    assert LINE.write("a;b=c %&?#/é") == "a%3Bb%3Dc%20%25%26%3F%23%2F%C3%A9"
    assert split_selector("a=1;b=x=y;c;;d=") == {"a": "1", "b": "x=y", "c": "", "d": ""}


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
    assert parse_command("calibrate", split_selector(selector_of(command.parameters()))) == command


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({"zero": "0.1", "reason": "x"}, "`machine` comes with one of"),
        ({"machine": "a", "auto": "maybe"}, "none of yes, no"),
        ({"machine": "a", "zero": "0.1"}, "`reason` is missing"),
        ({"machine": "a", "zero": "0.1", "auto": "yes", "reason": "x"}, "parameter `auto`"),
        ({"machine": "a", "zero": "0.51", "reason": "x"}, "`zero`: 0.51 is not between -0.5 and 0.5"),
        ({"machine": "a", "scale": "-0.91", "reason": "x"}, "`scale`: -0.91 is not between -0.9 and 0.9"),
        ({"machine": "a", "gain": "1", "reason": "x"}, "`gain` is not known"),
    ],
)
def test_a_wrong_calibrate_is_refused_by_name(parameters, words):
    with pytest.raises(QueryError, match=re.escape(words)):
        parse_command(
            "calibrate", {name: LINE.write(value) if name == "reason" else value for name, value in parameters.items()}
        )
    assert MOST_OFF == {"zero": 0.5, "scale": 0.9, "across": 0.5}, "as docs/protocol.md says"


values = st.floats(width=32)


def region_table(**fields) -> bytes:
    base = {"west_m": 0.0, "south_m": 0.0, "cell_m": 1.0, "columns": 2, "rows": 1, "layers": {"a": bytes(8)}}
    return pack({**base, "merged": 1, "stamp_ns": 1, **fields})


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"layers": {"a": bytes(7)}}, Refusal.COLUMN_LENGTH),
        ({"layers": {"a": "text"}}, Refusal.WRONG_TYPE),
        ({"layers": {b"a": bytes(8)}}, Refusal.COLUMN_LENGTH),
        ({"columns": -2, "rows": -1}, Refusal.OUT_OF_RANGE),
        ({"columns": 10**12}, Refusal.OUT_OF_RANGE),
        ({"cell_m": 0.0}, Refusal.OUT_OF_RANGE),
        ({"west_m": math.nan}, Refusal.NOT_FINITE),
    ],
)
def test_malformed_region_is_refused(fields, reason):
    with pytest.raises(MessageError) as caught:
        codec.decode_region(region_table(**fields))
    assert caught.value.reason is reason


@pytest.mark.parametrize(
    ("spans", "words"),
    [
        ([{"first_ns": 1, "values": {}}], "last_ns"),
        ([{"first_ns": 1, "last_ns": 2}], "values"),
        ([{"first_ns": 1, "last_ns": 2, "values": {"a": "high"}}], r"values\.a"),
        ({}, "spans: list expected"),
    ],
)
def test_malformed_history_is_refused(spans, words):
    with pytest.raises(MessageError, match=words):
        codec.decode_history(
            pack({"x_m": 0.5, "y_m": 0.5, "spans": spans, "store": STORE, "merged": 1, "fact": 0, "stamp_ns": 1})
        )


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


def test_fields_of_a_newer_server_are_ignored():
    newer = codec.encode_changes(answers.ChangesAnswer(({**asdict(CHANGE), "volume_m3": 4.0},), version()))
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
        ({"bounds": [1, 2]}, "info.bounds: 4 values expected, not 2"),
        ({"machines": {"a": {"spools": 1}}}, "info.machines.a.samples: missing"),
        ({"machines": {b"a": {}}}, "info.machines: the name b'a' is no text"),
        ({"counters": {"batches": 1.5}}, "info.counters.batches: int expected"),
        (
            {"site": {**asdict(INFO.site), "known_ground": [{"name": "pad", "c_rr": 2.0, "outline": []}]}},
            "not between 0",
        ),
    ],
)
def test_info_of_other_types_is_refused(values, words):
    with pytest.raises(MessageError, match=words):
        codec.decode_info(codec.encode_info({**asdict(INFO), **values}))


@pytest.mark.parametrize(
    "values",
    [
        {"store": "here"},
        {"store": None},
        {"fact": None},
    ],
)
def test_an_answer_without_the_version_of_its_map_is_refused(values):
    fields_of = {"values": {}, "x_m": 0.0, "y_m": 0.0, "store": STORE, "merged": 1, "fact": 0, "stamp_ns": 1}
    assert codec.decode_point(pack(fields_of)).version == version(1)
    with pytest.raises(MessageError, match=next(iter(values))):
        codec.decode_point(pack(fields_of | values))
