"""`sitegrid query`: options to queries, answers to lines or JSON."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import zenoh

from protocol.queries.answer_codec import encode_alive, encode_history, encode_info, encode_point, encode_region
from protocol.queries.answers import HistoryAnswer, HistorySpan, PointAnswer, Region, ServerAlive
from protocol.queries.parameters import split_selector
from protocol.queries.request import MapQuery
from protocol.queries.requests import (
    AliveQuery,
    HistoryQuery,
    InfoQuery,
    PointQuery,
    PointsQuery,
    RegionQuery,
    parse_query,
)
from protocol.queries.roads import Segments, SegmentsQuery, Worklist, WorklistQuery, encode_segments, encode_worklist
from protocol.queries.route_requests import RouteQuery, WayQuery
from protocol.queries.routing import MACHINES, NamedMachine
from protocol.site.geometry import Bounds
from protocol.site.site_config import SiteConfig
from sitegrid.answer_text import _value, _worded
from sitegrid.cli import main
from sitegrid.client import Client
from sitegrid.command_line import build_parser
from sitegrid.commands import query
from sitegrid.follower_choice import PAST_S
from tests.paths import GOLDEN
from tests.unit.records import STORE, map_info, version

T0 = 1_750_000_000_000_000_000  # 2025-06-15 15:06:40 UTC
S = 10**9
SITE = SiteConfig("pit", 48.0, 11.0)


class Session:
    """A Zenoh session that answers from a table, and records queries and timeouts."""

    def __init__(self, now_ns: int = T0) -> None:
        self.asked: list[MapQuery] = []
        self.timeouts: list[float] = []
        self.now_ns = now_ns

    def get(self, selector: zenoh.Selector, timeout: float) -> list[Any]:
        name = str(selector.key_expr).rsplit("/", 1)[-1]
        parsed = parse_query(name, split_selector(str(selector.parameters)))
        self.asked.append(parsed)
        self.timeouts.append(timeout)
        return [Reply(self._answer(parsed))]

    def close(self) -> None: ...

    def liveliness(self) -> SimpleNamespace:
        return SimpleNamespace(get=lambda _, timeout: [])  # no followers

    def _answer(self, asked: MapQuery) -> bytes:
        if isinstance(asked, InfoQuery):
            return encode_info(map_info(SITE, stamp_ns=self.now_ns))
        if isinstance(asked, AliveQuery):
            return encode_alive(ServerAlive(STORE, 18, 17, 0.5))
        if isinstance(asked, HistoryQuery):
            first = HistorySpan(T0, T0 + 299, {"resistance": 0.25, "age_s": math.nan})
            spans = (first, HistorySpan(T0 + 300 * S, T0, {"resistance": 0.5, "age_s": 3.0}))
            return encode_history(HistoryAnswer(0.5, 1.5, () if asked.x_m < 0 else spans, version(17, 3), T0))
        if isinstance(asked, SegmentsQuery | WorklistQuery):
            return (GOLDEN / f"{asked.name}.bin").read_bytes() if asked.from_ns is None else self._no_roads(asked)
        if isinstance(asked, RouteQuery | WayQuery):
            return (GOLDEN / "route.bin").read_bytes()
        if isinstance(asked, PointsQuery):
            return (GOLDEN / "points.bin").read_bytes()
        assert isinstance(asked, PointQuery | RegionQuery)
        stamp_ns = asked.as_of_ns or self.now_ns
        if isinstance(asked, PointQuery):
            return encode_point(PointAnswer(0.5, 1.5, {"visits": 2.0}, version(17, 3), stamp_ns))
        layers = {"visits": np.ones((1, 1), np.float32)}
        return encode_region(Region(np.array([0.5]), np.array([1.5]), 1.0, layers, version(17, 3), stamp_ns))

    def _no_roads(self, asked: MapQuery) -> bytes:
        if isinstance(asked, WorklistQuery):
            return encode_worklist(Worklist(STORE, 17, 3, T0, 0.0, asked.target, 0.0, (), ()))
        return encode_segments(Segments(STORE, 17, 3, T0, 0.0, 1.0, ()))


class Reply:
    def __init__(self, data: bytes) -> None:
        self.ok = self.payload = self
        self.err = self.attachment = None
        self.to_bytes = lambda: data


@pytest.fixture
def session(monkeypatch) -> Session:
    session = Session()
    monkeypatch.setattr("sitegrid.client.open_session", lambda _: session)
    return session


def test_a_time_that_cannot_be_counted_names_its_option(session: Session, capsys):
    session.now_ns = 0
    assert main(["query", "point", "1", "2", "--as-of", "-2h"]) == 1
    assert "sitegrid: --as-of: the site has no samples yet" in capsys.readouterr().err


@pytest.mark.parametrize(("option", "ask"), [("--as-of", "point"), ("--minus", "point"), ("--to", "history")])
def test_a_bad_time_is_a_usage_error_that_names_its_option(capsys, option: str, ask: str):
    with pytest.raises(SystemExit) as end:
        main(["query", ask, "1", "2", option, "yesterday"])
    assert end.value.code == 2
    assert f"argument {option}: 'yesterday' is no time" in capsys.readouterr().err


def test_point_and_region_are_asked_as_of_a_time_and_less_another(session: Session):
    times = ["--as-of", "2025-06-15T15:00:00", "--minus", "-2h"]
    assert main(["query", "--after", "3", "--layers", "visits", "point", "-500", "-2.5", *times]) == 0
    assert main(["query", "region", "-5", "0", "1", "2", *times]) == 0
    when = {"as_of_ns": T0 - 400 * S, "minus_ns": T0 - 7200 * S}
    point, region = (asked for asked in session.asked if not isinstance(asked, InfoQuery))
    assert point == PointQuery(-500.0, -2.5, ("visits",), after=3, **when)
    assert region == RegionQuery(Bounds(-5, 0, 1, 2), **when)


def test_a_worklist_is_a_table_with_what_changed_below(session: Session, capsys):
    assert main(["query", "worklist", "--target", "0.03", "--as-of", str(T0)]) == 0
    assert session.asked[-1] == WorklistQuery(0.03, as_of_ns=T0)
    head, names, row, changed = capsys.readouterr().out.splitlines()
    assert head == "4.50 kWh/h lost on all roads against a resistance of 0.02, calculated from 90 minutes of traffic"
    assert names.split()[:3] == ["section", "around", "kWh/h"]
    assert row.split()[:5] == ["1", "3_-2_e", "80,", "-44", "3.50"]
    assert "3.25..3.75" in row
    assert "3_-2_e: resistance 0.0625 -> 0.03125, saves 2.50 kWh/h" in changed
    assert main(["query", "worklist", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["rows"][0]["segment"]["id"] == "3_-2_e"
    assert main(["query", "worklist", "--from", str(T0)]) == 0
    assert "no section is worse beyond doubt" in capsys.readouterr().out


def test_a_route_is_its_totals_and_a_table_of_steps(session: Session, capsys):
    words = ["query", "--after", "3", "route", "0", "0", "30", "40", "--machine", "truck", "--mass", "30000"]
    assert main([*words, "--unknown", "refuse", "--as-of", str(T0)]) == 0
    truck = replace(MACHINES["truck"], mass_kg=30_000.0)
    line = ((0.0, 0.0), (30.0, 40.0))
    assert session.asked[-1] == RouteQuery(line, machine=truck, unknown="refuse", as_of_ns=T0, after=3)
    length, machine, cost, names, first, last = capsys.readouterr().out.splitlines()
    assert length == "50 m, +1.5 m up, 50% unknown, 25% driven and not measured"
    assert machine == "22.0 t, at most 6 m/s, 140 kW"
    assert cost == "0.28 kWh (0.25..0.35), 0.11 l of diesel, 0.06 kWh braked, 20 s (20..21)"
    assert names.split()[:4] == ["m", "from", "resistance", "+-"]
    assert (first.split()[0], last.split()[1]) == ("0", "2,3")
    assert main(["query", "route", "0", "0", "30", "40", "--json"]) == 0
    table = json.loads(capsys.readouterr().out)
    assert table["totals"]["energy_j"] == 1e6
    assert table["steps"]["confidence"] == [0.75, None]
    assert table["machine"]["mass_kg"] == 22_000.0
    assert main(["query", "route", "0", "0", "30", "40", "--machine", "truck-1"]) == 0
    assert session.asked[-1] == RouteQuery(line, machine=NamedMachine("truck-1"))


def test_a_way_names_its_places(session: Session, capsys):
    assert main(["query", "way", "0", "-5", "30", "40", "--cost", "time", "--avoid", "3", "4", "5", "6"]) == 0
    assert session.asked[-1] == WayQuery((0.0, -5.0), (30.0, 40.0), cost="time", avoid=((3.0, 4.0), (5.0, 6.0)))
    assert "2 places: 0,0 30,40" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (["route", "1", "2"], "parameter `line`: 1 places; a line has at least two"),
        (["route", "1", "2", "3"], "parameter `line`: 3 numbers"),
        (["route", "1", "2", "3", "4", "--mass", "-1"], "parameter `mass`: -1 is not positive"),
        (["--layers", "visits", "route", "1", "2", "3", "4"], "parameter `layers` is not known"),
        (["way", "1", "2", "1", "2"], "parameter `to`: the same place as `from`"),
    ],
)
def test_a_drive_that_cannot_be_is_refused_before_anybody_is_asked(session: Session, capsys, words, problem):
    assert main(["query", *words]) == 1
    assert problem in capsys.readouterr().err
    assert session.asked == []


def test_points_are_a_table_in_their_order(session: Session, capsys):
    assert main(["query", "--layers", "resistance,visits", "points", "0", "2", "1.5", "2", "-4", "0"]) == 0
    places = ((0.0, 2.0), (1.5, 2.0), (-4.0, 0.0))
    assert session.asked[-1] == PointsQuery(places, ("resistance", "visits"))
    head, *rows = capsys.readouterr().out.splitlines()
    assert head.split() == ["x", "y", "resistance", "visits"]
    assert [row.split()[2] for row in rows] == ["0.02", "unknown", "0.25"]
    assert main(["query", "points", "0", "2", "--as-of", str(T0), "--json"]) == 0
    assert session.asked[-1] == PointsQuery(((0.0, 2.0),), as_of_ns=T0)
    assert json.loads(capsys.readouterr().out)["resistance"][1] is None
    assert main(["query", "points", "0", "2", "1"]) == 1
    assert "3 numbers; places are pairs x,y" in capsys.readouterr().err


def test_a_region_may_be_an_outline_and_have_larger_cells(session: Session, capsys):
    corners = ((0.0, 0.0), (10.0, -5.0), (5.0, 9.0))
    words = ["0", "0", "10", "-5", "5", "9"]
    assert main(["query", "region", *words, "--resolution", "2"]) == 0
    assert session.asked[-1] == RegionQuery(corners, resolution_m=2.0)
    asked = len(session.asked)
    assert main(["query", "region", "0", "0", "10", "10", "10", "0", "0", "10"]) == 1
    assert "parameter `polygon`: its sides from corners 1 and 3 on cross each other" in capsys.readouterr().err
    assert main(["query", "region", "0", "0"]) == 1
    assert "parameter `polygon`: 1 corners; an outline has at least three" in capsys.readouterr().err
    assert len(session.asked) == asked


def test_segments_are_a_table(session: Session, capsys):
    assert main(["query", "--after", "3", "segments"]) == 0
    assert session.asked[-1] == SegmentsQuery(after=3)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "0.05 km of roads, traffic of 1.50 h"
    assert lines[2].startswith("3_-2_e")
    assert "unknown" in lines[3]
    assert main(["query", "segments", "--from", str(T0)]) == 0
    assert capsys.readouterr().out == "no roads are known\n"


def test_a_history_is_asked_with_its_times(session: Session, capsys):
    assert main(["query", "--layers", "a,b", "history", "1", "-2"]) == 0
    times = ["--from", "-1h", "--to", str(T0), "--span", "60"]
    assert main(["query", "history", "1", "-2", *times]) == 0
    assert session.asked[0] == HistoryQuery(1.0, -2.0, ("a", "b"))
    assert session.asked[2] == HistoryQuery(1.0, -2.0, query.HISTORY_LAYERS, T0 - 3600 * S, T0, 60.0)
    assert main(["query", "history", "1", "-2", "--json"]) == 0
    assert session.asked[3] == HistoryQuery(1.0, -2.0)  # all layers, too wide for any terminal
    assert main(["query", "history", "1", "2", "--span", "0"]) == 1
    assert "parameter `span`: 0 s is not between 1" in capsys.readouterr().err


def test_answers_that_are_folded_first_are_waited_for_longer(session: Session):
    client = Client(session, "tcp/x", "pit", timeout_s=1.0)  # type: ignore[arg-type]
    client.point(0, 0)
    client.ask(PointQuery(0, 0, after=3, wait_s=5.0))
    client.point(0, 0, as_of=T0)
    client.ask(RegionQuery(Bounds(0, 0, 1, 1), minus_ns=T0))
    client.ask(HistoryQuery(0, 0, after=3, wait_s=5.0))
    assert session.timeouts == pytest.approx([1, 6, 1 + PAST_S, 1 + PAST_S, 6 + PAST_S], abs=0.5)


def test_the_python_client_passes_every_argument(session: Session):
    client = Client(session, "tcp/x", "pit")  # type: ignore[arg-type]
    client.point(1, 2, ["a"], as_of=5)
    client.region((0, 1, 2, 3), "a, b", as_of=5)
    client.region([(0, 0), (3, 0), (0, 3)], resolution_m=2)
    client.route([(0, 0), (3, 4)], "truck-1", as_of=5)
    assert session.asked == [
        PointQuery(1.0, 2.0, ("a",), as_of_ns=5),
        RegionQuery(Bounds(0, 1, 2, 3), ("a", "b"), as_of_ns=5),
        RegionQuery(((0.0, 0.0), (3.0, 0.0), (0.0, 3.0)), (), 2.0),
        RouteQuery(((0.0, 0.0), (3.0, 4.0)), machine=NamedMachine("truck-1"), as_of_ns=5),
    ]


def test_every_option_of_query_stands_before_its_name_or_after_it(capsys):
    parser = build_parser()

    def helped(*words: str) -> str:
        with pytest.raises(SystemExit):
            parser.parse_args(["query", *words, "--help"])
        return capsys.readouterr().out

    values = {"--json": [], "--verbose": [], "--layers": ["visits"], "--after": ["3"], "--site": ["pit"]}
    values |= {"--endpoint": ["tcp/h:1"], "--keys": ["k"]}
    assert set(re.findall(r"^  (--[a-z]+)", helped(), re.MULTILINE)) == values.keys()
    places = {"point": 2, "points": 2, "history": 2, "why": 2, "region": 4, "route": 4, "way": 4}
    names = re.findall(r"^    ([a-z]+) ", helped(), re.MULTILINE)
    assert places.keys() < set(names)
    for name in names:
        ask = [name, *["1"] * places.get(name, 0)]
        for option, value in values.items():
            before, after = (
                parser.parse_args(["query", *words]) for words in ([option, *value, *ask], [*ask, option, *value])
            )
            assert before == after != parser.parse_args(["query", *ask]), (name, option)


VERSION = {"store": STORE, "merged": 17, "fact": 3}


def test_machines_see_stamps(session: Session, capsys, tmp_path: Path):
    main(["query", "point", "1", "2", "--as-of", "-1h", "--json"])
    answer = json.loads(capsys.readouterr().out)
    assert answer == {"x_m": 0.5, "y_m": 1.5, "visits": 2.0, **VERSION, "stamp_ns": T0 - 3600 * S}
    main(["query", "region", "0", "1", "1", "2", "--as-of", "-1h", "--json", "--out", str(tmp_path / "a.npz")])
    assert json.loads(capsys.readouterr().out)["stamp_ns"] == T0 - 3600 * S
    assert np.load(tmp_path / "a.npz")["visits"].tolist() == [[1.0]]
    main(["query", "history", "1", "2", "--json"])
    spans = json.loads(capsys.readouterr().out)["spans"]
    assert spans[0] == {"first_ns": T0, "last_ns": T0 + 299, "resistance": 0.25, "age_s": None}


def test_a_history_is_a_table_for_people(session: Session, capsys):
    main(["query", "history", "1", "2"])
    assert capsys.readouterr().out.splitlines() == [
        "from (UTC)            resistance  age_s",
        "2025-06-15 15:06:40Z  0.25        unknown",
        "2025-06-15 15:11:40Z  0.5         3",
    ]
    main(["query", "history", "-1", "2"])
    assert capsys.readouterr().out == "nothing is driven yet\n"


@pytest.mark.parametrize(
    ("value", "shown"),
    [(math.nan, "unknown"), (-0.0, "0"), (-1e-9, "-1e-09"), (2.0, "2")],
)
def test_a_value_for_people_has_no_minus_zero(value: float, shown: str):
    assert _value(value) == shown


def test_values_have_units_and_classes_their_names(session: Session):
    classes = {"resistance_class": ("concrete", "gravel"), "slope_class": ("flat", "slope")}
    worded = [_worded(*pair, classes) for pair in (("grade", -0.02), ("resistance_class", 1.0), ("slope_class", 0.0))]
    assert worded == ["-0.02 m/m", "1, gravel", "0, flat"]
    assert _worded("resistance_class", math.nan, classes) == "unknown"


@pytest.mark.parametrize(("words", "meant"), [("quer", "query or router"), ("query pont", "point or points")])
def test_a_mistyped_word_names_those_that_it_may_mean(capsys, words: str, meant: str):
    with pytest.raises(SystemExit) as end:
        main(words.split())
    assert end.value.code == 2
    assert capsys.readouterr().err.endswith(f"did you mean {meant}?\n")


def test_a_probe_is_one_line_or_one_object(session: Session, capsys):
    assert main(["query", "alive"]) == 0
    assert capsys.readouterr().out == "batches are taken: journal row 18, merged 17\n"
    assert main(["query", "alive", "--json"]) == 0
    expected = {"store": STORE, "journalled": 18, "merged": 17, "busy_s": 0.5}
    assert json.loads(capsys.readouterr().out) == expected


def test_people_see_the_time_of_an_answer(session: Session, capsys):
    def first_line(*words: str) -> str:
        assert main(["query", *words]) == 0
        return capsys.readouterr().out.splitlines()[0]

    assert first_line("point", "1", "2") == "cell at 0.5, 1.5 m"
    as_of, minus = ["--as-of", str(T0 - 40 * S)], ["--minus", str(T0 - 100 * S)]
    assert first_line("point", "1", "2", *as_of) == "cell at 0.5, 1.5 m, as of 2025-06-15 15:06:00Z"
    assert first_line("point", "1", "2", *minus) == "cell at 0.5, 1.5 m, minus that of 2025-06-15 15:05:00Z"
    line = first_line("region", "0", "1", "1", "2", *as_of, *minus)
    assert "as of 2025-06-15 15:06:00Z, minus that of 2025-06-15 15:05:00Z, journal row 17" in line
