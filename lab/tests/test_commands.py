"""`python -m lab`: commands declare themselves, refuse errors in one line, pass options on."""

import json
import math
from argparse import Action, ArgumentParser
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from lab import commands
from sitegrid.command_line import build_parser, run
from sitegrid.options.values import count, positive, seed

# Entry point of each command; these take seeds.
WORK = {
    "calibration": "lab.calibration.experiment",
    "can": "lab.can.experiment",
    "cooperation": "lab.cooperation.experiment",
    "fedback": "lab.fedback.experiment",
    "ground": "lab.ground.experiment",
    "maps": "lab.maps.experiment",
    "paper": "lab.paper.experiment",
    "positions": "lab.positions.experiment",
    "roads": "lab.roads.experiment",
    "routes": "lab.routes.experiment",
    "sensitivity": "lab.sensitivity",
}
WRONG = {count: "0", seed: "-1", positive: "inf"}
REPORT = {"scenario": "paper_site", "seconds": math.nan, "rows": [{"name": "a", "net_m": 1.5, "by_seed": [1, 2]}]}


def main(*words: str) -> int:
    return run(words, commands, "python -m lab")


def parsers(parser: ArgumentParser) -> dict[str, ArgumentParser]:
    return next(a.choices for a in parser._actions if isinstance(a.choices, dict))


def wrong_words() -> list[tuple[str, ...]]:
    """Every option of every command with an invalid value."""

    def wrong_word(name: str, option: Action) -> tuple[str, ...] | None:
        wrong = "nonsense" if option.choices and option.option_strings else WRONG.get(option.type)
        return (name, option.option_strings[-1], wrong) if wrong else None

    all_of = parsers(build_parser(commands, "python -m lab"))
    return [
        words for name, parser in all_of.items() for option in parser._actions if (words := wrong_word(name, option))
    ]


def test_every_wrong_value_is_a_usage_error(capsys):
    refused = wrong_words()
    assert len(refused) > 3 * len(WORK)
    for words in refused:
        with pytest.raises(SystemExit) as end:
            main(*words)
        assert end.value.code == 2, words
        assert words[1] in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize("name", WORK)
def test_options_reach_the_experiment_and_its_report_is_one_object(name: str, monkeypatch, capsys, tmp_path: Path):
    asked: list[Any] = []
    monkeypatch.setattr(
        import_module(WORK[name]),
        "run",
        lambda runner, *more, **options: (
            asked.append((runner, more[0] if more else options.get("plan", SimpleNamespace(**options)))),
            (REPORT, []),
        )[1],
    )
    seconds = () if name == "maps" else ("--seconds", "600")
    words = (name, "--seeds", "2", "--first-seed", "1000", *seconds, "--processes", "3", "--json")
    assert main(*words, "--out", str(tmp_path)) == 0
    ((runner, given),) = asked
    assert (runner.cache, runner.processes) == (tmp_path, 3)
    assert list(given.seeds) == [1000, 1001]
    assert name == "maps" or "600.0" in repr(given)
    printed = json.loads(capsys.readouterr().out)
    assert printed["rows"] == REPORT["rows"]
    assert printed["seconds"] is None
    assert printed["made"]["command"].startswith(f"python -m lab {name} --seeds 2")


@pytest.mark.parametrize("name", ["maps", "roads", "routes"])
def test_an_unknown_case_is_one_line(name: str, capsys):
    assert main(name, "--cases", "nowhere") == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "nowhere" in line
    assert "known: " in line


@pytest.mark.parametrize(
    "words",
    [
        ("paper", "--quick", "--seeds", "2"),
        ("cooperation", "--quick", "--seconds", "30"),
        ("paper", "--quick", "--tables", "maps"),
        ("paper", "--tables", "positions", "--tensor", "map.npy"),
    ],
)
def test_options_that_do_not_fit_together_are_one_line(words: tuple[str, ...], capsys):
    assert main(*words) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert words[1] in line
