import json
import math

import numpy as np
import pytest

from agents.pipeline import Pipeline
from agents.positioning import PipelineConfig
from lab.speed.__main__ import main
from lab.speed.agents import agent, smoother
from lab.speed.agents import filter as filters

STEPS = ("predict", "update position", "update rate")


@pytest.mark.slow
def test_filter_prints_one_json_object_with_every_step_of_every_filter(monkeypatch, capsys) -> None:
    monkeypatch.setattr(agent, "SECONDS", 20)
    monkeypatch.setattr(smoother, "SECONDS", 20)
    assert main(["filter", "--json", "--steps", "3", "--runs", "1"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert (result["benchmark"], result["steps"], result["runs"]) == ("filter", 3, 1)
    rows = result["rows"]
    kinds = ("stock ukf", "stock ukf, angles", "ukf", "ekf")
    assert [(row["filter"], row["step"]) for row in rows] == [(kind, step) for kind in kinds for step in STEPS]
    assert all(set(row) == {"filter", "step", "us", "x_stock", "x_stock_angles"} for row in rows)
    assert all(math.isfinite(value) for row in rows for value in row.values() if not isinstance(value, str))
    assert [(row["filter"], row["lag_s"]) for row in result["smoother"]] == [("ekf", 90.0), ("ukf", 90.0)]
    # A difference of two timings: below zero where other work gets in between, but not by a whole pipeline.
    assert all(abs(row["smoother_percent"]) < row["cpu_percent"] for row in result["smoother"])
    (whole,) = result["agent"]
    assert whole["seconds"] == 20
    assert whole["cpu_percent"] > 0
    assert whole["memory_mb"] > 20


def test_filter_prints_three_tables(monkeypatch, capsys) -> None:
    monkeypatch.setattr(smoother, "measured", lambda runs: [{"filter": "ekf", "cpu_percent": 0.5}])
    monkeypatch.setattr(agent, "measured", lambda runs: {"seconds": 1, "cpu_percent": 0.5, "memory_mb": 100.0})
    main(["filter", "--steps", "1", "--runs", "1"])
    steps, smoothing, whole = capsys.readouterr().out.split("\n\n")
    assert steps.splitlines()[0].split() == ["filter", "step", "us", "x_stock", "x_stock_angles"]
    assert len(steps.splitlines()) == 13
    assert smoothing.split() == ["filter", "cpu_percent", "ekf", "0.5"]
    assert whole.split() == ["seconds", "cpu_percent", "memory_mb", "1", "0.5", "100.0"]


def test_own_and_stock_move_alike() -> None:
    """What is compared is the same work."""
    start = filters._start()
    moves = filters.motion(filters.MODEL, start, 0.3)
    np.testing.assert_allclose(filters._stock_motion(start.x, 0.3), moves.f(start.x[None])[0], atol=1e-14)


def test_the_agents_readings_come_at_their_rates_and_give_a_pose() -> None:
    pipeline = Pipeline(agent.SITE, agent.machine(), PipelineConfig())
    for readings in agent.bundles(20):
        counts = {s.name: sum(r.sensor == s.name for r in readings) for s in agent.machine().sensors}
        assert counts == {"imu": 100, "wheels": 50, "gps-1": 5, "gps-2": 5}
        assert [r.stamp_ns for r in readings] == sorted(r.stamp_ns for r in readings)
        pipeline.step(readings)
    pose = pipeline.pose
    assert pose is not None
    assert math.dist((pose.x_m, pose.y_m), agent.place(agent.progress(20)[0])[:2]) < 1.0
