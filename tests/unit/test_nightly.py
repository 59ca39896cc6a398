"""The nightly command: failing parts stop no others, passed ones are not repeated, hangs end."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from tests import nightly
from tests.nightly import NIGHT_S, PARTS, TESTS, Part, main
from tests.paths import ROOT


def part(name: str, module: str, folder: Path, budget_s: float = 60.0) -> Part:
    """A part that runs a line of Python."""
    (folder / f"{name}.py").write_text(module)
    return Part(name, budget_s, ((name,),))


@pytest.fixture
def modules(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}{os.pathsep}{ROOT}")
    monkeypatch.setattr(nightly, "raise_interrupts", lambda: None)
    return tmp_path


def test_the_night_keeps_its_budget_and_its_paths_exist() -> None:
    assert sum(one.budget_s for one in PARTS) <= NIGHT_S
    tests = [command for one in PARTS for command in one.commands if command[: len(TESTS)] == TESTS]
    paths = [word for command in tests for word in command if word.startswith(("tests/", "lab/"))]
    assert len(paths) > 5
    assert [path for path in paths if not (ROOT / path).exists()] == []


def test_a_part_that_fails_stops_no_other_and_alone_is_run_again(modules: Path, capsys) -> None:
    counted = "from pathlib import Path; Path('{}').open('a').write('x')"
    runs = {name: modules / f"{name}.txt" for name in ("good", "bad")}
    good = part("good", counted.format(runs["good"]), modules)
    bad = part("bad", counted.format(runs["bad"]) + "; raise SystemExit(3)", modules)
    state = modules / "state"
    assert main(["--json"], (bad, good), state) == 1
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert (result["ok"], [(row["name"], row["ok"]) for row in result["parts"]]) == (
        False,
        [("bad", False), ("good", True)],
    )
    assert main([], (bad, good), state) == 1
    assert {name: path.read_text() for name, path in runs.items()} == {"good": "x", "bad": "xx"}
    assert main(["good"], (bad, good), state) == 0, "of what was asked for"
    part("bad", counted.format(runs["bad"]), modules)
    assert main([], (bad, good), state) == 0
    assert {name: path.read_text() for name, path in runs.items()} == {"good": "xx", "bad": "xxx"}
    assert main([], (bad, good), state) == 0, "a night that has passed is followed by another one"
    assert main(["--again"], (bad, good), state) == 0
    assert {name: path.read_text() for name, path in runs.items()} == {"good": "xxxx", "bad": "xxxxx"}


def test_a_part_that_hangs_is_ended_and_fails(modules: Path, capsys) -> None:
    hangs = part("hangs", "import threading; threading.Event().wait()", modules, budget_s=0.1)
    assert main([], (hangs,), modules / "state") == 1
    assert "still at work after 0 s" in (modules / "state" / "hangs.log").read_text()
    assert "FAILED" in capsys.readouterr().out


def test_an_unknown_part_is_refused(capsys) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(["gold"])
    assert "no part `gold`; there are tests, chaos" in capsys.readouterr().err
