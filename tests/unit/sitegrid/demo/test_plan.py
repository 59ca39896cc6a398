"""The demo's plan: options reach their targets."""

from __future__ import annotations

import sys
import threading
from pathlib import Path
from unittest.mock import Mock

import pytest

from protocol.errors import ConfigError, LinkError
from sitegrid.command_line import build_parser
from sitegrid.demo.plan import DemoPlan, make_plan, start_sim
from sitegrid.demo.run import _watch, stays
from tests.paths import ROOT


def plan_of(tmp_path: Path, *words: str) -> DemoPlan:
    return make_plan(build_parser().parse_args(["demo", "--out", str(tmp_path), *words]))


def test_every_option_is_passed_on_to_the_simulator(tmp_path: Path):
    class Started:
        def start(self, name: str, *words: object) -> list[str]:
            return [str(word) for word in words]

    options = ("--seconds", "33.0", "--speed", "7.0", "--machines", "2", "--seed", "9")
    options = (*options, "--scenario", "repaved", "--world", "fast")
    words = start_sim(plan_of(tmp_path, *options), Started())
    pairs = dict(zip(options[::2], options[1::2], strict=True))
    assert all(words[words.index(name) + 1] == value for name, value in pairs.items())


@pytest.mark.parametrize(
    ("words", "on_terminal", "elsewhere"),
    [([], False, False), (["--web"], True, False), (["--web", "--json"], False, False), (["--stay"], True, True)],
)
def test_the_page_stays_on_a_terminal_or_where_it_is_asked_for(words, on_terminal, elsewhere, monkeypatch):
    arguments = build_parser().parse_args(["demo", *words])
    for is_terminal, expected in ((True, on_terminal), (False, elsewhere)):
        monkeypatch.setattr(sys.stderr, "isatty", lambda is_terminal=is_terminal: is_terminal)
        assert stays(arguments) == expected


def test_a_server_too_busy_for_a_picture_does_not_end_the_demo(tmp_path: Path, monkeypatch):
    asked: list[float] = []
    sim = Mock(code=None, lines=Mock(return_value=[]))

    def region(*_: object) -> None:
        asked.append(clock[0])
        sim.code = 0 if len(asked) == 2 else None
        raise LinkError("tcp/127.0.0.1:1", "the map server did not answer in time")

    def later() -> float:
        clock[0] += 2.0
        return clock[0]

    clock = [0.0]
    monkeypatch.setattr("sitegrid.demo.run.time.monotonic", later)
    client, display = Mock(region=region), Mock()
    stop = Mock(spec=threading.Event, wait=Mock(return_value=False))
    _watch(plan_of(tmp_path), client, Mock(), (sim, {}), (stop, display))
    assert len(asked) == 2


def test_an_earlier_run_is_cleared_away(tmp_path: Path):
    out = tmp_path / "made" / "by the demo"
    old = plan_of(out).work / "loader-9.db"
    old.write_text("old")
    plan_of(out)
    assert not old.exists()


def test_what_is_not_of_an_earlier_run_is_left_alone(tmp_path: Path):
    (tmp_path / "work").mkdir()
    mine = tmp_path / "work" / "thesis.tex"
    mine.write_text("mine")
    with pytest.raises(ConfigError, match="is not of an earlier demo"):
        plan_of(tmp_path)
    assert mine.exists()


def test_a_log_is_replayed_where_it_is_named(tmp_path: Path):
    assert plan_of(tmp_path).log is None
    manifest = ROOT / "lab/logs/rl_test1_husky/log.toml"
    demo = plan_of(tmp_path, "--log", str(manifest), "--data", str(tmp_path))
    assert demo.log.data == tmp_path
    with pytest.raises(ConfigError, match=r"nowhere.toml: no such file"):
        plan_of(tmp_path, "--log", "nowhere.toml")
