"""`sitegrid log` in process: tables, JSON, exit codes, one-line errors."""

import json
from pathlib import Path

import pytest

from sitegrid import cli
from tests.unit.sitegrid.logs.data import write_circle

TRUTH = '[truth]\nfile = "true.csv"\nstamp = "t"\nx_m = "x"\ny_m = "y"\n'


@pytest.fixture
def circle(tmp_path: Path) -> Path:
    return write_circle(tmp_path)


def test_check_prints_a_table_and_lines(circle: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["log", "check", str(circle)]) == 0
    said = capsys.readouterr()
    assert not said.err
    head, *rows = said.out.splitlines()
    assert head.split() == [
        *("sensor", "kind", "usable", "refused", "begins_s", "ends_s", "rate_hz", "gaps", "longest_gap_s")
    ]
    assert rows[0].split()[:3] == ["gps-1", "gps", "160"]
    assert "PASS  positions     by gps-1, wheels" in rows


def test_check_fails_where_nothing_can_be_run_and_says_so_in_json_too(
    circle: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (circle / "odom.csv").unlink()
    assert cli.main(["log", "check", str(circle), "--json"]) == 1
    report = json.loads(capsys.readouterr().out)
    assert report["ok"] is False
    assert [row["usable"] for row in report["rows"]] == [160, 0]
    levels = {(one["check"], one["level"]) for one in report["findings"]}
    assert {("wheels", "FAIL"), ("positions", "FAIL"), ("truth", "-"), ("ground", "-")} <= levels


@pytest.mark.slow
def test_run_prints_rows_and_what_it_cannot_compare_and_draws(circle: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["log", "run", str(circle), "--filter", "ekf", "--withhold", "none"]
    assert cli.main([*words, "--picture", str(circle / "log.png")]) == 0
    said = capsys.readouterr()
    assert (circle / "log.png").read_bytes().startswith(b"\x89PNG")
    assert "\ntruth: no true track is known; describe one as [truth] in evaluation.toml" in said.out
    assert "\nground: no IMU with forces, which gradient and rolling resistance need" in said.out
    assert "measurement" in said.out
    assert said.err == "circle: none\n"
    (circle / "evaluation.toml").write_text(TRUTH)
    (circle / "true.csv").write_text((circle / "gps.csv").read_text())
    assert cli.main([*words, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["rows"][0]["truth_net_m"] < 1.0
    assert list(report["missing"]) == ["ground"]


REFUSED = {  # change of a file, command words, message
    "no manifest": ("log.toml", None, ["run"], "has no log.toml that describes its files; docs/log-folders.md"),
    "no TOML": ("log.toml", "[log", ["check"], "log.toml: not valid TOML"),
    "no file": ("gps.csv", None, ["run"], "gps.csv: is not there; `--data` names the folder of the files"),
    "two columns of a name": ("gps.csv", "t,x,y,x\n0,1,2,3\n", ["run"], "has 2 columns `x`; name its columns"),
    "truth of another table": ("evaluation.toml", "[turth]\n", ["run"], "unknown key `turth`; known: truth, ground"),
    "an option that is none": ("evaluation.toml", "", ["run", "--set", "sart=[0,0,0]"], "--set: unknown key `sart`"),
    "an outage behind the end": ("evaluation.toml", "", ["run", "--withhold", "900,5"], "the log ends after 80 s"),
}


@pytest.mark.parametrize(("file", "text", "words", "problem"), REFUSED.values(), ids=REFUSED)
def test_what_cannot_be_read_is_refused_in_one_line(
    circle: Path, capsys: pytest.CaptureFixture[str], file: str, text: str | None, words: list[str], problem: str
) -> None:
    (circle / file).unlink(missing_ok=True)
    if text is not None:
        (circle / file).write_text(text)
    assert cli.main(["log", words[0], str(circle), *words[1:]]) == 1
    said = capsys.readouterr()
    assert not said.out
    assert said.err.startswith("sitegrid: ")
    assert said.err.count("\n") == 1
    assert problem in said.err


@pytest.mark.parametrize("words", [["--picture", "log.gif"], ["--picture", "nowhere/log.png"]])
def test_a_picture_that_cannot_be_written_is_refused_before_the_work(
    circle: Path, capsys: pytest.CaptureFixture[str], words: list[str]
) -> None:
    assert cli.main(["log", "run", str(circle), *words]) == 1
    assert capsys.readouterr().err.count("\n") == 1
