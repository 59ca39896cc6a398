"""Quick version of cooperation: real agents, router and map server as processes."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from lab.campaign.experiment import Runner
from lab.cooperation import experiment, live
from lab.cooperation.experiment import QUICK, Outcome
from sitegrid.process.lifetime import plain
from sitegrid.proof.figures import Report

STORED = Path(__file__).parent / "quick.json"
# Tolerances in points: the time of decisions varies between runs.
WITHIN = {"covered_pct": 15.0, "wrong_pct": 15.0, "c_rr_pct": 15.0, "driven_wrong_pct": 15.0, "grade_pct": 0.2}
EXACT = ("arm", "machines", "link", "recorded_s", "known_pct", "driven_known_pct")

pytestmark = [pytest.mark.processes, pytest.mark.slow, pytest.mark.timeout(600)]


@pytest.fixture(scope="module")
def runner(tmp_path_factory: pytest.TempPathFactory) -> Runner:
    return Runner(tmp_path_factory.mktemp("cache"))


@pytest.fixture(scope="module")
def result(runner: Runner) -> tuple[Report, list[Outcome]]:
    report, outcomes = experiment.run(runner, QUICK)
    return plain(report), list(outcomes)


def rows(report: Report) -> dict[str, dict]:
    return {row["arm"]: row for row in report["rows"]}


def test_every_machine_was_a_process_of_its_own_and_all_have_ended(result):
    (run,) = result[1][0].runs
    assert set(run.pids) == {"router", "server", "loader-1", "loader-2"}
    assert len({*run.pids.values(), os.getpid()}) == 5
    for pid in run.pids.values():
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)


def test_the_server_has_what_one_process_makes_of_the_same_readings_bit_for_bit(result):
    (run,) = result[1][0].runs
    assert len(run.samples) > 300
    assert run.delivered
    assert rows(result[0])["central"]["same_pct"] == 100.0


def test_its_figures_are_near_those_that_are_stored(result):
    """From `python -m lab cooperation --quick --json`."""
    stored, ours = rows(json.loads(STORED.read_text())), rows(result[0])
    assert list(ours) == list(stored) == ["two", "central"]
    for name, row in ours.items():
        assert {key: row[key] for key in EXACT} == {key: stored[name][key] for key in EXACT}
        for key, off in WITHIN.items():
            assert row[key] == pytest.approx(stored[name][key], abs=off), (name, key)
    # One process has no races: equal to the printed digits.
    assert {**ours["central"], "same_pct": None} == {**stored["central"], "same_pct": None}


def test_it_goes_on_where_it_was(result, runner: Runner, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(live, "run", lambda *_: pytest.fail("runs an arm again"))
    report, _ = experiment.run(runner, QUICK)
    assert plain(report) == result[0]
