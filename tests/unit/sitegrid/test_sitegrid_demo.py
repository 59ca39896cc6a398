"""The demo's plan: each option reaches what it should."""

from __future__ import annotations

import io
import sys
from pathlib import Path

import pytest

from protocol.errors import ConfigError
from protocol.site import load_site
from sitegrid import progress
from sitegrid.cli import build_parser
from sitegrid.commands import demo
from sitegrid.progress import Display


def plan(tmp_path: Path, *words: str) -> demo.Plan:
    return demo._plan(build_parser().parse_args(["demo", "--out", str(tmp_path), *words]))


def test_options_reach_the_simulation(tmp_path: Path):
    sim = plan(tmp_path, "--seconds", "33", "--speed", "7", "--machines", "2", "--seed", "9", "--no-log").sim
    assert (sim.seconds, sim.speed, sim.machines, sim.seed) == (33, 7, 2, 9)


def test_the_plan_writes_a_file_for_the_site_and_each_machine(tmp_path: Path):
    found = plan(tmp_path, "--machines", "2", "--no-log")
    assert [path.name for path in found.configs] == ["loader-1.toml", "loader-2.toml"]
    assert load_site(found.site_file()).name == "paper"
    assert found.out == tmp_path


def test_an_earlier_run_is_cleared_away(tmp_path: Path):
    (tmp_path / "work").mkdir()
    old = tmp_path / "work" / "loader-9.db"
    old.write_text("old")
    plan(tmp_path, "--no-log")
    assert not old.exists()


def test_the_default_log_is_used_only_where_its_data_lies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    assert plan(tmp_path).log is None
    manifest = Path(__file__).parents[3] / demo.DEFAULT_MANIFEST
    monkeypatch.setattr(demo, "DEFAULT_MANIFEST", manifest)
    monkeypatch.setattr(demo, "DEFAULT_DATA", tmp_path)
    assert plan(tmp_path).log.name == "rl_test1_husky"
    assert plan(tmp_path, "--no-log").log is None


def test_a_log_of_ones_own_needs_no_default(tmp_path: Path):
    manifest = Path(__file__).parents[3] / demo.DEFAULT_MANIFEST
    found = plan(tmp_path, "--log", str(manifest), "--data", str(tmp_path))
    assert found.log.data == tmp_path
    with pytest.raises(ConfigError, match=r"nowhere.toml: no such file"):
        plan(tmp_path, "--log", "nowhere.toml")


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_terminal_gets_a_bar_and_headless_gets_lines(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sys, "stderr", Terminal())
    with Display(headless=False) as display:
        display.show(5, 10, {"samples_merged": 7, "cells": 3})
        assert display._bar.tasks[0].completed == 5
    with Display(headless=True) as display:
        assert display._bar is None
        display.show(5, 10, {"samples_merged": 7, "cells": 3})
    assert "5 of 10 s driven, 7 samples, 3 cells" in sys.stderr.getvalue()


def test_plain_lines_come_now_and_then_only(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    now = iter([100.0, 100.0, 101.0, 106.0, 106.0])
    monkeypatch.setattr(progress.time, "monotonic", lambda: next(now))
    display = Display(headless=True)
    for second in (1, 2, 3):
        display.show(second, 10, {})
    assert capsys.readouterr().err.count("driven") == 2
