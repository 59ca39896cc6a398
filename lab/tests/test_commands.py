"""`sitegrid eval`: options reach the experiment, reports become JSON or tables."""

import argparse
import json
import math
from pathlib import Path

import pytest

from sitegrid import cli
from sitegrid.commands import eval as command
from sitegrid.door import build_parser

MANIFEST = """
log = { name = "empty", start_ns = 1 }
site = { name = "yard", origin_lat_deg = 50.0, origin_lon_deg = 8.0 }
machine = { name = "mower" }
[[sensor]]
name = "wheels"
kind = "encoder"
file = "wheels.csv"
columns = { stamp = "t", left_ticks = "l", right_ticks = "r" }
"""


def parse(*words: str) -> argparse.Namespace:
    return build_parser().parse_args(["eval", *words])


@pytest.mark.slow
def test_options_of_an_experiment_reach_it(monkeypatch, capsys):
    from lab.positions import table

    asked = []
    report = {"scenario": "paper_site", "seconds": math.nan, "rows": []}
    monkeypatch.setattr(table, "run", lambda runner, **options: (asked.append((runner, options)), (report, []))[1])
    words = ["eval", "localisation", "--seeds", "2", "--first-seed", "1000", "--rows", "headline", "--seconds", "60"]
    assert cli.main([*words, "--out", "x", "--processes", "3", "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert (printed["scenario"], printed["seconds"], printed["rows"]) == ("paper_site", None, [])
    assert cli.main(["eval", "localisation"]) == 0
    assert capsys.readouterr().out.startswith("scenario: paper_site")
    (runner, options), (default, default_options) = asked
    assert (runner.cache, runner.processes) == (Path("x"), 3)
    assert default.processes > 0
    assert (list(options["seeds"]), options["seconds"], len(options["rows"])) == ([1000, 1001], 60.0, 12)
    assert [len(default_options[name]) for name in ("seeds", "rows")] == [12, 36]
    assert default_options["seconds"] == 1200.0


@pytest.mark.slow
def test_the_budget_has_no_pictures_and_its_report_is_printed(monkeypatch, capsys):
    from lab.campaign.recordings import DRIVEN, PAPER
    from lab.positions import budget

    asked = []
    report = {"rows": [{"gps": 1, "truth": "none", "net_m": 1.5, "net_by_seed_m": [1.5]}]}
    monkeypatch.setattr(budget, "run", lambda _, **options: (asked.append(options), (report, {}))[1])
    assert cli.main(["eval", "budget", "--seeds", "2", "--seconds", "600"]) == 0
    assert "none" in capsys.readouterr().out
    assert asked == [{"seeds": range(2), "seconds": 600.0, "setup": PAPER}]
    assert cli.main(["eval", "budget", "--scenario", "paper_site_driven", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["rows"][0]["net_by_seed_m"] == [1.5]
    assert asked[1] == {"seeds": range(12), "seconds": 1200.0, "setup": DRIVEN}
    with pytest.raises(SystemExit):
        parse("budget", "--plots", "x")


@pytest.mark.slow
def test_the_table_is_made_on_the_scenario_that_is_asked_for(monkeypatch, capsys):
    from lab.campaign.recordings import SETUPS
    from lab.positions import table

    assert tuple(SETUPS) == command.SCENARIOS
    asked = []
    monkeypatch.setattr(table, "run", lambda _, **options: (asked.append(options["setup"]), ({"rows": []}, []))[1])
    for words in ((), ("--scenario", "haul_road_driven")):
        assert cli.main(["eval", "localisation", *words, "--json"]) == 0
    assert asked == [SETUPS["paper_site"], SETUPS["haul_road_driven"]]
    with pytest.raises(SystemExit):
        parse("localisation", "--scenario", "loading")
    assert "invalid choice: 'loading'" in capsys.readouterr().err


@pytest.mark.parametrize("words", [("--json", "physics"), ("physics", "--json")])
def test_json_stands_before_or_behind_what_is_run(words: tuple[str, ...]):
    assert parse(*words).json
    assert not parse("physics").json


def test_withheld_time_is_given_as_seconds_of_a_period_or_as_start_and_length():
    words = ("--withhold", "10/30", "--withhold", "none", "--withhold", "0,60.5")
    assert parse("log", "m", *words).withhold == [("/", 10.0, 30.0), ("none", 0.0, 0.0), (",", 0.0, 60.5)]
    assert parse("log", "m").withhold is None


def test_receivers_are_given_as_a_number_or_by_name_and_options_as_files_have_them():
    given = parse(
        "log", "m", "--gps", "2", "--sensors", "imu, gps-1", "--set", "start=[1, 2, 0.5]", "--set", "filter=ekf"
    )
    assert (given.gps, given.sensors) == (2, ("imu", "gps-1"))
    assert given.set == [("start", [1, 2, 0.5]), ("filter", "ekf")]
    assert parse("log", "m", "--gps", "gps-1,gps-3").gps == ("gps-1", "gps-3")


@pytest.mark.parametrize(
    "words",
    [
        *(("log", "m", "--withhold", bad) for bad in ("30/10", "10", "a/b", "0/10", "1/inf", "nan/3")),
        *(("log", "m", "--withhold", bad) for bad in ("-1,5", "5,0", "1,inf", "nan,3", "1,2,3", ",", "")),
        *(("log", "m", "--gps", bad) for bad in ("0", "-1", "", "gps-1,")),
        *(("log", "m", "--set", bad) for bad in ("slip", "=3", "slip=")),
        ("log", "m", "--sensors", ","),
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


def test_a_log_that_the_pipeline_cannot_run_is_one_line(tmp_path: Path, capsys):
    (tmp_path / "log.toml").write_text(MANIFEST)
    (tmp_path / "wheels.csv").write_text("t,l,r\n1,0,0\n")
    assert cli.main(["eval", "log", str(tmp_path), "--gps", "1"]) == 1
    assert capsys.readouterr().err == "sitegrid: mower has 0 GPS receivers, not 1\n"
    assert cli.main(["eval", "log", str(tmp_path), "--set", "slip=wet"]) == 1
    assert capsys.readouterr().err == "sitegrid: --set slip: float is expected, not str ('wet')\n"
    assert cli.main(["eval", "log", str(tmp_path), "--set", "slid=1"]) == 1
    assert "--set: unknown key `slid`; known: filter, profile, start" in capsys.readouterr().err
    assert cli.main(["eval", "log", str(tmp_path)]) == 1
    assert "mower: no sensor in use shows its place" in capsys.readouterr().err
    assert cli.main(["eval", "log", str(tmp_path / "none.toml"), "--json"]) == 1
    assert "no such file" in json.loads(capsys.readouterr().err)["error"]


def test_tables_for_people_line_up_without_lists():
    rows = [{"a": 1, "bb": None, "by_seed": [1]}, {"a": 22.5, "bb": "x", "by_seed": [2]}]
    (text,) = command._lines({"rows": rows, "missing": []})
    assert text.splitlines() == ["   a  bb", "   1   -", "22.5   x"]


def test_physics_still_runs(monkeypatch, capsys):
    from lab import physics

    monkeypatch.setattr(physics, "run", lambda seeds, on_progress: {"rows": [{"seeds": len(seeds)}], "tours": []})
    assert cli.main(["eval", "physics", "--seeds", "4"]) == 0
    assert capsys.readouterr().out == "seeds\n    4\n"
