"""Machines, trust and changes from Python and the command line."""

from __future__ import annotations

import json
import os
import re
import sys
import threading
from collections.abc import Iterator
from dataclasses import replace

import pytest
import zenoh

from protocol.errors import QueryError, Refusal
from protocol.queries.answer_codec import encode_change, encode_changes, encode_error, encode_machine, encode_machines
from protocol.queries.answers import ChangesAnswer, GroundChange, MachinesAnswer, TrustAnswer
from protocol.queries.calibration import CalibrationAnswer, CorrectedSpan, MachineCalibration, encode_calibration
from protocol.queries.commands import CalibrateCommand, TrustCommand, parse_command
from protocol.queries.parameters import split_selector
from protocol.queries.requests import CalibrationQuery, ChangesQuery, MachinesQuery, parse_query
from protocol.wire import keys
from protocol.wire.session import SessionConfig, free_endpoint, open_session
from sitegrid.cli import main
from sitegrid.client import Client, connect
from sitegrid.commands import query
from sitegrid.process.lifetime import plain
from tests.patience import PATIENCE_S
from tests.unit.records import STORE, machine_state, version

T0 = 1_750_000_000_000_000_000
FOUND = {"trusted": False, "by": "audit", "since_ns": T0 + 60 * 10**9, "contradicts": True, "reasons": ("gain",)}
MACHINES = [
    machine_state("a", samples=1200, lost=3, newest_ns=T0),
    machine_state("b", **FOUND, evidence={"gain": 1.6}, samples=7, newest_ns=T0),
]
CHANGE = GroundChange(4, T0, T0 + 60 * 10**9, (10.0, -20.0, 40.0, 12.5), 615, 0.25, 0.008, None, None)

UNKNOWN = dict.fromkeys(("zero", "zero_std", "scale", "scale_std", "across", "across_std"))
KNOWN = {"zero": 0.0025, "zero_std": 0.0005, "scale": -0.03, "scale_std": 0.005, "across": 0.0, "across_std": 0.001}
SPANS = (CorrectedSpan(0, T0, 0.1, 0.0, 0.0, 10.0), CorrectedSpan(T0, 2**62, 0.00251, -0.03, 0.0, 10.0))
CALIBRATION = CalibrationAnswer(
    STORE,
    17,
    3,
    T0,
    0.03,
    "no_slope_both_ways",
    (
        MachineCalibration(
            "a", "person", "levelled", T0, **KNOWN, zero_by=("heights", "crossings"), scale_by=(), spans=SPANS
        ),
        MachineCalibration("b", "", "", 0, **UNKNOWN, zero_by=(), scale_by=(), spans=()),
    ),
)


class FakeServer:
    """Answers machines, calibration, changes and trust on its own router, and records queries."""

    def __init__(self) -> None:
        self.endpoint = free_endpoint()
        self.session = open_session(SessionConfig(self.endpoint, mode="router"))
        self.asked: list[object] = []
        self._queryables = [
            self.session.declare_queryable(keys.map_queries_all("pit"), self._on_query),
            self.session.declare_queryable(keys.admin_all("pit"), self._on_command),
        ]

    def _on_query(self, query: zenoh.Query) -> None:
        with query:
            parsed = parse_query(keys.query_of(str(query.key_expr)), split_selector(str(query.parameters)))
            self.asked.append(parsed)
            answers = {
                MachinesQuery: lambda: encode_machines(MachinesAnswer(tuple(MACHINES), version())),
                CalibrationQuery: lambda: encode_calibration(CALIBRATION),
                ChangesQuery: lambda: encode_changes(ChangesAnswer((CHANGE,), version())),
            }
            query.reply(query.key_expr, answers[type(parsed)]())

    def _on_command(self, query: zenoh.Query) -> None:
        with query:
            command = parse_command(keys.query_of(str(query.key_expr)), split_selector(str(query.parameters)))
            self.asked.append(command)
            if command.machine == "nobody":
                query.reply_err(encode_error(QueryError(Refusal.UNKNOWN_MACHINE, "machine `nobody` is not known")))
                return
            if isinstance(command, CalibrateCommand):
                query.reply(query.key_expr, encode_calibration(CALIBRATION))
                return
            machine = machine_state(command.machine, trusted=command.trusted is not False)
            query.reply(query.key_expr, encode_machine(TrustAnswer(**vars(machine), store=STORE, merged=17, fact=3)))

    def publish(self, payload: bytes) -> None:
        self.session.put(keys.changed("pit"), payload)

    def close(self) -> None:
        for queryable in self._queryables:
            queryable.undeclare()
        self.session.close()


@pytest.fixture(scope="module")
def running() -> Iterator[FakeServer]:
    server = FakeServer()
    yield server
    server.close()


@pytest.fixture
def server(running: FakeServer) -> FakeServer:
    running.asked.clear()
    return running


@pytest.fixture
def client(server: FakeServer) -> Iterator[Client]:
    with connect(server.endpoint, "pit") as client:
        yield client


def sitegrid(server: FakeServer, *words: str) -> int:
    noun, *rest = words
    return main([noun, "--endpoint", server.endpoint, "--site", "pit", *rest])


# --- from Python -----------------------------------------------------------------------------------------------------


class Callback:
    """A recording callback that fails on change 666."""

    def __init__(self) -> None:
        self.events: list[GroundChange] = []
        self._more = threading.Condition()

    def __call__(self, event: GroundChange) -> None:
        with self._more:
            self.events.append(event)
            self._more.notify_all()
        if event.id == 666:
            raise RuntimeError("a bug in a callback")

    def wait(self, n: int) -> list[GroundChange]:
        with self._more:
            assert self._more.wait_for(lambda: len(self.events) >= n, PATIENCE_S)
            return list(self.events)


def test_a_change_calls_back_until_it_is_closed(server: FakeServer, client: Client):
    first, other = Callback(), Callback()
    listener = client.on_change(first)
    client.on_change(other)
    client.changes()  # its answer proves the subscription is known
    failing = replace(CHANGE, id=666)
    for payload in (b"no message", encode_change({"id": 5}), encode_change(failing), encode_change(CHANGE)):
        server.publish(payload)
    assert first.wait(2) == [failing, CHANGE]
    listener.close()
    listener.close()
    server.publish(encode_change(replace(CHANGE, id=5)))
    assert other.wait(3)[2].id == 5
    assert len(first.events) == 2


def test_a_slow_callback_stalls_nothing(server: FakeServer, client: Client):
    entered, release = threading.Event(), threading.Event()
    quick = Callback()

    def slow(_: object) -> None:
        entered.set()
        release.wait(PATIENCE_S)

    client.on_change(slow)
    client.on_change(quick)
    client.changes()
    for i in range(600):  # more than Zenoh holds for a callback
        server.publish(encode_change(replace(CHANGE, id=i)))
    assert entered.wait(PATIENCE_S)
    assert [event.id for event in quick.wait(600)] == list(range(600))
    assert client.changes() == [CHANGE]
    release.set()


def test_a_callback_may_close_its_own_listener(server: FakeServer, client: Client):
    closed = threading.Event()

    def once(_: object) -> None:
        listener.close()
        closed.set()

    listener = client.on_change(once)
    client.changes()
    server.publish(encode_change(CHANGE))
    assert closed.wait(PATIENCE_S)


# --- from the command line -------------------------------------------------------------------------------------------


def test_trust_and_distrust_reach_the_server(server: FakeServer, capsys):
    assert sitegrid(server, "distrust", "b", "--reason", "hit a wall; 3 m off", "--wait", "5") == 0
    assert capsys.readouterr().out == "b is left out of the map, as of journal row 17\n"
    assert sitegrid(server, "trust", "b") == 0
    assert capsys.readouterr().out == "b is trusted, as of journal row 17\n"
    assert sitegrid(server, "trust", "b", "--auto", "--json") == 0
    assert json.loads(capsys.readouterr().out) == plain(
        TrustAnswer(**vars(machine_state("b")), store=STORE, merged=17, fact=3)
    )
    assert server.asked == [
        TrustCommand("b", False, "hit a wall; 3 m off", 5.0),
        TrustCommand("b", True),
        TrustCommand("b", None),
    ]
    assert sitegrid(server, "trust", "nobody") == 1
    assert capsys.readouterr().err == "sitegrid: machine `nobody` is not known\n"


def test_calibration_is_asked_for_and_said(server: FakeServer, client: Client, capsys):
    assert client.calibrate(wait_s=2.0) == client.ask(CalibrationQuery(after=3)) == CALIBRATION
    assert client.correct("a", "levelled", zero=0.004, across=-0.01) == CALIBRATION
    assert client.calibrate_automatically("a") == CALIBRATION
    assert sitegrid(server, "calibrate", "--wait", "5") == 0
    head, first, second, common = capsys.readouterr().out.splitlines()
    assert head.split("  ")[0] == "machine"
    assert first.split()[:7] == ["a", "0.0025", "0.0005", "-0.03", "0.005", "0", "0.001"]
    assert "zero heights+crossings" in first
    assert "0.00251, -0.03, 0 2025-06-15 15:06:40Z" in first
    assert first.endswith("person: levelled")
    assert second.split() == ["b", *["unknown"] * 6, "-", "nothing", "-"]
    assert common == "nothing shows the mean scale of all machines: no_slope_both_ways"
    assert sitegrid(server, "query", "calibration", "--json") == 0
    assert json.loads(capsys.readouterr().out) == plain(CALIBRATION)
    assert sitegrid(server, "calibrate", "a", "--scale", "-0.03", "--reason", "weighed; 22 t") == 0
    assert sitegrid(server, "calibrate", "a", "--auto", "--json") == 0
    assert server.asked == [
        CalibrateCommand(wait_s=2.0),
        CalibrationQuery(after=3),
        CalibrateCommand("a", 0.004, None, -0.01, reason="levelled"),
        CalibrateCommand("a", auto=True),
        CalibrateCommand(wait_s=5.0),
        CalibrationQuery(),
        CalibrateCommand("a", None, -0.03, reason="weighed; 22 t"),
        CalibrateCommand("a", auto=True),
    ]
    capsys.readouterr()
    assert sitegrid(server, "calibrate", "nobody", "--auto") == 1
    assert capsys.readouterr().err == "sitegrid: machine `nobody` is not known\n"


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (["--zero", "0.1"], "--zero: is about one machine: name it"),
        (["--auto"], "--auto: is about one machine: name it"),
        (["a"], "a: give --zero, --scale, --across or --auto"),
        (["a", "--zero", "0.1"], "--reason: is missing"),
        (["a", "--zero", "0.1", "--auto", "--reason", "x"], "--zero: is a person's value"),
    ],
)
def test_a_calibration_that_cannot_be_meant_is_refused_before_anybody_is_asked(words, problem, capsys):
    assert main(["calibrate", *words]) == 1
    assert capsys.readouterr().err.startswith(f"sitegrid: {problem}")


def test_machines_are_a_table_for_people(server: FakeServer, capsys):
    assert sitegrid(server, "query", "machines") == 0
    head, first, second = capsys.readouterr().out.splitlines()
    named = ["machine", "trusted", "since", "samples", "lost", "newest", "accelerometer zero", "torque gain", "why"]
    assert re.split("  +", head) == named
    assert re.split("  +", first) == ["a", "yes", "-", "1200", "3", "2025-06-15 15:06:40Z", "-", "-", "-"]
    assert second.startswith("b        NO, by audit  2025-06-15 15:07:40Z  7        0     2025-06-15 15:06:40Z  ")
    assert second.endswith("  measures 1.60 times the resistance that the others do")
    assert sitegrid(server, "query", "--after", "3", "machines", "--json") == 0
    assert json.loads(capsys.readouterr().out) == {"machines": plain(MACHINES)}
    assert server.asked[-1] == MachinesQuery(after=3)


def test_changes_are_a_line_each(server: FakeServer, capsys):
    assert sitegrid(server, "query", "--after", "3", "changes") == 0
    assert capsys.readouterr().out == (
        "4: 2025-06-15 15:06:40Z to 2025-06-15 15:07:40Z  10..40 x -20..12.5 m  615 cells  resistance 0.25 -> 0.008\n"
    )
    assert sitegrid(server, "query", "changes", "--json") == 0
    assert json.loads(capsys.readouterr().out) == {"changes": [plain(CHANGE)]}
    assert server.asked == [ChangesQuery(3), ChangesQuery(0)]


@pytest.mark.parametrize("as_json", [True, False])
def test_changes_are_followed_until_stopped(server: FakeServer, monkeypatch, capsys, as_json: bool):
    """The known change, then one found while following."""
    stop = threading.Event()
    monkeypatch.setattr(query, "stop_flag", lambda: stop)
    shown: list[str] = []

    def show(text: object, **_: object) -> None:
        shown.append(text if isinstance(text, str) else json.dumps(text))
        if len(shown) == 1:
            server.publish(encode_change(replace(CHANGE, cells=700)))
        else:
            stop.set()

    monkeypatch.setattr(query, "say", show)
    monkeypatch.setattr(query, "tell", show)
    watchdog = threading.Timer(PATIENCE_S, stop.set)
    watchdog.start()
    assert sitegrid(server, "query", "changes", "--follow", *(["--json"] if as_json else [])) == 0
    watchdog.cancel()
    assert ["615" in shown[0], "700" in shown[1], len(shown)] == [True, True, 2]
    assert shown[0].startswith("{") == as_json


def test_a_reader_that_leaves_ends_what_is_followed(server: FakeServer, monkeypatch, capsys):
    stop = threading.Event()
    monkeypatch.setattr(query, "stop_flag", lambda: stop)
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "w") as output:
        monkeypatch.setattr(sys, "stdout", output)
        assert sitegrid(server, "query", "changes", "--follow") == 0
        monkeypatch.undo()
    assert stop.is_set()
