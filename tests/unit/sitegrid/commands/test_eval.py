"""`sitegrid eval`: options become a plan, results become JSON or tables."""

import argparse
import json
from pathlib import Path

import pytest

from benchmarks.measure import table
from sitegrid import cli

MANIFEST = """
[log]
name = "empty"
start_ns = 1
[site]
name = "yard"
origin_lat_deg = 50.0
origin_lon_deg = 8.0
[machine]
name = "mower"
[[sensor]]
name = "wheels"
kind = "encoder"
file = "wheels.csv"
columns = { stamp = "t", left_ticks = "l", right_ticks = "r" }
"""


def parse(*words: str) -> argparse.Namespace:
    return cli.build_parser().parse_args(["eval", *words])


def test_options_of_the_table_become_a_plan(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    from evaluation.positions import table

    plans = []
    nan = float("nan")
    report = {"rows": [{"net_m": nan, "net_by_seed_m": [1.0]}], "missing": []}
    monkeypatch.setattr(table, "run", lambda plan, _: (plans.append(plan), (report, []))[1])
    words = ["eval", "localisation", "--seeds", "2", "--first-seed", "1000", "--rows", "headline", "--seconds", "60"]
    assert cli.main([*words, "--out", "x", "--processes", "3", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"rows": [{"net_m": None, "net_by_seed_m": [1.0]}], "missing": []}
    (plan,) = plans
    assert (plan.seeds, plan.seconds, plan.cache, plan.processes) == ((1000, 1001), 60.0, Path("x"), 3)
    assert len(plan.rows) == 12
    assert cli.main(["eval", "localisation"]) == 0
    assert "net_by_seed_m" not in capsys.readouterr().out
    assert (len(plans[1].seeds), plans[1].seconds, len(plans[1].rows)) == (12, 1200.0, 36)


@pytest.mark.parametrize("words", [("--json", "physics"), ("physics", "--json")])
def test_json_stands_before_or_behind_what_is_run(words: tuple[str, ...]):
    assert parse(*words).json
    assert not parse("physics").json


def test_withheld_time_is_given_as_seconds_of_a_period():
    assert parse("log", "m", "--withhold", "10/30", "--withhold", "none").withhold == [(10.0, 30.0), (0.0, 1.0)]
    assert parse("log", "m").withhold is None


@pytest.mark.parametrize(
    "words",
    [
        *(("log", "m", "--withhold", bad) for bad in ("30/10", "10", "a/b", "0/10", "1/inf", "nan/3")),
        ("localisation", "--seeds", "0"),
        ("localisation", "--first-seed", "-1"),
        ("localisation", "--seconds", "0"),
        ("localisation", "--rows", "some"),
    ],
)
def test_bad_options_are_usage_errors(words: tuple[str, ...]):
    with pytest.raises(SystemExit) as end:
        parse(*words)
    assert end.value.code == 2


def test_a_log_that_the_pipeline_cannot_run_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "log.toml").write_text(MANIFEST)
    (tmp_path / "wheels.csv").write_text("t,l,r\n1,0,0\n")
    assert cli.main(["eval", "log", str(tmp_path), "--gps", "1"]) == 1
    assert capsys.readouterr().err == "sitegrid: mower has 0 GPS receivers, not 1\n"
    assert cli.main(["eval", "log", str(tmp_path / "none.toml"), "--json"]) == 1
    assert "no such file" in json.loads(capsys.readouterr().err)["error"]


def test_tables_for_people_line_up():
    text = table([{"a": 1, "bb": None}, {"a": 22.5, "bb": "x"}])
    assert text.splitlines() == ["   a  bb", "   1   -", "22.5   x"]


def test_physics_still_runs(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    from evaluation import physics

    monkeypatch.setattr(physics, "run", lambda seeds, on_progress: {"rows": [{"seeds": len(seeds)}], "tours": []})
    assert cli.main(["eval", "physics", "--seeds", "4"]) == 0
    assert capsys.readouterr().out == "seeds\n    4\n"
