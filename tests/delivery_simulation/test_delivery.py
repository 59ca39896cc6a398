"""Delivery under seeded faults; and proof that the simulation detects mistakes."""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Iterator

import pytest

from tests.delivery_simulation.__main__ import main, run_one, run_seeds
from tests.delivery_simulation.bugs import BUGS


@pytest.fixture(autouse=True)
def _quiet() -> Iterator[None]:
    logging.disable()
    yield
    logging.disable(logging.NOTSET)


@pytest.mark.slow
def test_nothing_is_lost_or_double_in_any_world() -> None:
    lines: list[str] = []
    sums = run_seeds(0, 60, say=lines.append)
    assert not lines, lines[0]
    assert sums["recorded"] > 1200
    assert sums["journalled"] > 0.6 * sums["recorded"]
    events = sums["events"]
    for name in ("agent_kills", "server_kills", "disk_full", "late", "clones", "spool_restores", "server_restores"):
        assert events[name] > 0, f"no {name} in these seeds"


@pytest.mark.slow
def test_nothing_is_lost_or_double_with_the_real_store() -> None:
    lines: list[str] = []
    sums = run_seeds(0, 25, real=True, say=lines.append)
    assert not lines, lines[0]
    assert sums["recorded"] > 500


SHOWN_FROM = {"failed_commit_stays_open": 100, "final_values_are_given_up": 79}  # first worlds that reveal it


@pytest.mark.slow
@pytest.mark.parametrize("name", BUGS)
def test_planted_bug_is_found(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    BUGS[name](monkeypatch)
    lines: list[str] = []
    sums = run_seeds(SHOWN_FROM.get(name, 0), 200, say=lines.append, stop_at_failure=True)
    assert sums["failed"] == 1
    assert f"replay: python -m tests.delivery_simulation --seed {sums['failed_seeds'][0]} --trace" in lines[0]


def test_same_seed_is_the_same_world() -> None:
    traces: list[list[str]] = [[], []]
    for trace in traces:
        run_one(3, say=trace.append)
    assert traces[0] == traces[1]
    assert len(traces[0]) > 20


def test_command_prints_one_object_last(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(sys, "argv", ["delivery_simulation", "--seeds", "3", "--json"])
    assert main() == 0
    table = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert (table["seeds"], table["lost"], table["double"], table["failed"]) == (3, 0, 0, 0)
