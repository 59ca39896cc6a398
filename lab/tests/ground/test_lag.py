"""Maps with and without the smoother's lag, of short drives in the fast world."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from lab.campaign.experiment import Runner
from lab.campaign.recordings import Setup
from lab.ground import lag
from lab.ground.lag import LagConfiguration, LagResult
from sitegrid import cli
from sitegrid.proof.figures import Report

FAST = Setup("loading", ("west", "east"), gps=(1, 2), imu=(3,), world="fast", preset="dgps")
SECONDS = 40.0


@pytest.fixture(scope="module")
def runner(tmp_path_factory: pytest.TempPathFactory) -> Runner:
    return Runner(tmp_path_factory.mktemp("cache"))


@pytest.fixture(scope="module")
def result(runner: Runner) -> tuple[Report, list[LagResult]]:
    return lag.run(runner, (5,), SECONDS, FAST, (0.0, 8.0))


@pytest.mark.slow
def test_both_rows_have_the_same_readings_and_the_same_cells(result, runner: Runner) -> None:
    report, results = result
    without, smoothed, true = report["rows"]
    assert (without["lag_s"], smoothed["lag_s"], true["lag_s"]) == (0.0, 8.0, None)
    assert true["place_off_m"] < 1e-6
    assert true["cells"] == without["cells"]
    assert true["known_pct"] > without["known_pct"]
    assert (without["fall_pct"], without["samples"], without["cells"]) == (0.0, smoothed["samples"], smoothed["cells"])
    assert without["cells"] > 100
    assert sum(row["cells"] for row in without["by_border"]) == without["cells"]
    assert smoothed["place_off_m"] != without["place_off_m"] > 0.1
    assert len(list(runner.cache.glob("dgps-seed5-*/logs/*"))) == 4, "one drive of all four machines"
    assert [results[0].samples, results[1].samples] == [without["samples"], smoothed["samples"]]


def made(wrong_pct: float, known_pct: float = 50.0) -> LagResult:
    near = {"from_m": 0.0, "to_m": 1.0, "cells": 20, "known_pct": known_pct, "wrong_pct": wrong_pct}
    far = {"from_m": 1.0, "to_m": None, "cells": 0, "known_pct": np.nan, "wrong_pct": np.nan}
    return LagResult(100, 20, known_pct, wrong_pct, 0.0, 1.0, [near, far])


def test_fall_is_that_of_each_seed_against_its_own_map_without_a_lag() -> None:
    first = [made(2.0), made(4.0), made(0.0)]
    row = lag.summarise(LagConfiguration(90.0), [made(1.0), made(3.0), made(0.0)], first)
    assert row["fall_by_seed_pct"][:2] == [50.0, 25.0]
    assert np.isnan(row["fall_by_seed_pct"][2]), "nothing was wrong that could fall"
    assert (row["fall_pct"], row["wrong_resistance_pct"]) == (37.5, 1.333)
    assert row["fall_ci95"] == pytest.approx(12.706 * 12.5, rel=1e-3)
    assert [row["by_border"][0][name] for name in ("cells", "wrong_pct")] == [60, 1.333]
    assert np.isnan(row["by_border"][1]["wrong_pct"])


@pytest.mark.slow
def test_command_prints_rows_and_the_goal(monkeypatch, capsys, tmp_path: Path) -> None:
    report = {"rows": [lag.summarise(LagConfiguration(0.0), [made(2.0)], [made(2.0)])], "goals": []}
    asked: list[dict] = []
    monkeypatch.setattr(lag, "run", lambda runner, **options: (asked.append(options), (report, []))[1])
    words = ["eval", "lag", "--seeds", "2", "--first-seed", "3", "--seconds", "60", "--out", str(tmp_path), "--json"]
    assert cli.main(words) == 0
    assert asked == [{"seeds": range(3, 5), "seconds": 60.0}]
    assert json.loads(capsys.readouterr().out)["rows"][0]["fall_pct"] == 0.0
