"""The paper's report: rows of synthetic figures, and the quick version with stored figures."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from lab import commands
from lab.campaign.experiment import Runner
from lab.paper import experiment
from lab.paper.drives import ALONE, FLEETS, QUICK, Plan
from lab.paper.experiment import Outcomes, contradictions, map_row
from lab.paper.maps import OURS, PAPERS, SERVED
from sitegrid.command_line import run
from sitegrid.process.lifetime import plain
from sitegrid.proof.figures import Report

STORED = Path(__file__).parent / "quick.json"
NO_STORE = {"us_per_second": None}  # CPU time depends on the host


def figures(wrong_pct: float) -> dict:
    bins = [{"from_m": 0.0, "to_m": None, "cells": 10, "known_pct": 100.0, "wrong_pct": wrong_pct}] * 7
    places = {"rmse_x_m": 0.6, "rmse_y_m": 0.8, "net_m": 1.0}
    driven = {"wrong_resistance_pct": wrong_pct, "wrong_grade_pct": 0.5, "known_pct": 99.0, "cells": 100}
    plotted = {f"plotted_{name}": value * 2 for name, value in driven.items() if name != "known_pct"}
    return {**places, **driven, **plotted, "by_border": bins}


def test_a_row_of_the_papers_own_stands_beside_its_figures():
    row = map_row(ALONE[4], PAPERS, [figures(1.0), figures(3.0)], ())
    assert (row["filter"], row["gps"], row["imu"], row["profile"]) == ("ukf", 2, 1, "paper")
    assert (row["wrong_resistance_pct"], row["plotted_wrong_resistance_pct"]) == (2.0, 4.0)
    assert row["paper"]["wrong_resistance_pct"] == 0.997
    assert row["ci95"]["wrong_resistance_pct"] == pytest.approx(12.7062, abs=1e-4)
    assert row["by_seed"]["wrong_resistance_pct"] == [1.0, 3.0]
    assert row["by_border"][0] == {"from_m": 0.0, "to_m": None, "cells": 20, "known_pct": 100.0, "wrong_pct": 2.0}


def test_estimates_are_compared_with_the_same_samples_corrected_by_the_truth():
    seeds = [figures(1.0), figures(2.0)]
    assert map_row(FLEETS[1], SERVED, seeds, [figures(0.5), figures(2.2)])["above_true_pct"] == pytest.approx(0.15)
    assert map_row(FLEETS[1], SERVED, seeds, [figures(9.0)] * 2)["above_true_pct"] == 0.0
    row = map_row(FLEETS[1], OURS, seeds, ())
    assert row["above_true_pct"] is row["paper"] is None


def test_contradictions_of_the_paper_are_named():
    rows = contradictions()
    assert [(row["where"], row["group"]) for row in rows] == [
        ("Tables 1 and 2", "UKF 1 GPS 3 IMU"),
        ("Table 3", "EKF 1 GPS 1 IMU"),
    ]
    assert (rows[1]["net_m"], rows[1]["net_of_parts_m"]) == (4.4444, 4.2761)


# --- the quick version -----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def runner(tmp_path_factory: pytest.TempPathFactory) -> Runner:
    return Runner(tmp_path_factory.mktemp("cache"))


@pytest.fixture(scope="module")
def result(runner: Runner) -> tuple[Report, Outcomes]:
    return experiment.run(runner, QUICK)


@pytest.mark.slow
def test_the_quick_version_has_the_figures_that_are_stored(result):
    """From `python -m lab paper --quick --json`."""
    report = plain(result[0])
    stored = json.loads(STORED.read_text())
    assert [{**row, **NO_STORE} for row in report["rows"]] == [{**row, **NO_STORE} for row in stored["rows"]]
    assert {**report, "rows": []} == {**stored, "rows": []}


@pytest.mark.slow
def test_pictures_are_drawn(result, runner: Runner, tmp_path: Path):
    cv2 = pytest.importorskip("cv2")
    plots = pytest.importorskip("lab.paper.plots", reason="needs the extra `lab`")
    paths = plots.draw(result[1], runner, tmp_path)
    assert [p.stem for p in paths] == ["truth", "maps", "differences", "fleet_maps", "fleet_differences"]
    assert all(cv2.imread(str(path)).std() > 10 for path in paths)


# --- the command -----------------------------------------------------------------------------------------------------


def test_options_reach_the_plan(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    asked: list[Plan] = []
    monkeypatch.setattr(experiment, "run", lambda _, plan: (asked.append(plan), ({"rows": []}, None))[1])
    for more in ([], ["--quick"], ["--tables", "positions"], ["--tables", "maps"]):
        assert run(["paper", "--json", "--out", str(tmp_path), *more], commands) == 0
    whole = Plan(range(12), 1200.0)
    assert asked == [whole, QUICK, replace(whole, sources=()), replace(whole, positions=())]
