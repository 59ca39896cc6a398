"""The comparison of merges: a row per case and method, through the command line, and its pictures."""

import json
from collections.abc import Sequence
from dataclasses import asdict, fields, replace
from functools import cache
from pathlib import Path

import pytest

from evaluation.campaign.experiment import Runner, Task
from evaluation.maps import experiment
from evaluation.maps.cases import CASES, MapCase, select
from evaluation.maps.experiment import CaseResult, MergeRow
from evaluation.maps.figures import MapFigures
from sitegrid import cli

METHODS = ["soft_votes", "last_write", "mean", "median", "kalman"]
SMALL = tuple(replace(case, columns=45, rows=30) for case in CASES)
FIGURES = asdict(MapFigures(wrong_pct=1.0, known_pct=50.0, seconds=1.0))


def small(kind: str) -> MapCase:
    return next(case for case in SMALL if case.kind == kind)


class Here(Runner):
    """Does tasks in this process, each once in all tests, and keeps nothing."""

    def run(self, asked: experiment.Experiment, tasks: Sequence[Task]) -> list:
        return [result_of(asked, task) for task in tasks]


@cache
def result_of(asked: experiment.Experiment, task: Task) -> CaseResult:
    return asked.solve(task, Path())


@pytest.mark.slow
def test_every_case_and_method_has_a_row_with_the_figures_that_apply():
    report, _ = experiment.run(Here(Path()), (3,), SMALL)
    assert [(row.case, row.method) for row in report.rows] == [(c.kind, m) for c in CASES for m in METHODS]
    assert report.seeds == [3]
    assert len(report.goals) == len(experiment.GOALS)
    for row in report.rows:
        server = row.method == "soft_votes"
        assert (row.changed_wrong_pct is None) == (row.passes_after is None) == (row.case != "repaved")
        assert (row.unchanged_wrong_pct is None) == (row.case != "repaved")
        assert (row.near_wrong_pct is None) == (row.case != "parked_bad_machine")
        assert (row.width_m is None) == (row.case != "narrow_road")
        assert (row.share60_cells_pct is None) == (not server or row.case in ("grade_both_ways", "slope_15"))
        assert 0 <= row.wrong_min_pct <= row.wrong_pct <= row.wrong_max_pct
        assert row.known_pct > 50
        assert row.samples > row.cells > 0
    plain = asdict(report)
    assert json.loads(json.dumps(plain, allow_nan=False)) == plain


def test_rows_are_medians_over_seeds():
    results = [
        CaseResult(samples, 8, [], {"mean": {**FIGURES, "wrong_pct": wrong}})
        for samples, wrong in ((10, 1.0), (30, 4.0), (20, 2.00004))
    ]
    row = experiment.summarise(small("1x1"), "mean", results)
    assert (row.wrong_pct, row.wrong_min_pct, row.wrong_max_pct) == (2.0, 1.0, 4.0)
    assert row.wrong_by_seed_pct == [1.0, 4.0, 2.0]
    assert (row.samples, row.known_pct, row.near_wrong_pct, row.distrusted) == (20, 50.0, None, None)


def test_machines_that_the_server_excluded_are_counted_over_seeds():
    results = [CaseResult(1, 8, names, {"soft_votes": FIGURES}) for names in (["b"], [], ["b", "a"])]
    assert experiment.summarise(small("1x1"), "soft_votes", results).distrusted == {"a": 1, "b": 2}


def test_each_goal_names_a_figure_and_at_least_one_row():
    names = {field.name for field in fields(MergeRow)}
    keys = [(case.kind, case.passes_after) for case in CASES]
    for goal in experiment.GOALS:
        assert goal.figure in names
        case, passes_after, method = (goal.row.get(name) for name in ("case", "passes_after", "method"))
        assert method in METHODS
        assert (case, passes_after) in keys


# --- the command -----------------------------------------------------------------------------------------------------


def test_an_unknown_case_is_one_line(capsys: pytest.CaptureFixture[str]):
    assert cli.main(["eval", "merge", "--cases", "1x1,2x2"]) == 1
    error = capsys.readouterr().err
    assert error.startswith("sitegrid: --cases: `2x2` is not known; known: 1x1, 1x4, 4x4, bad_machine,")
    assert error.count("\n") == 1


def test_options_choose_seeds_and_cases(monkeypatch: pytest.MonkeyPatch):
    asked = []
    report = experiment.MergeReport([], [], [])
    monkeypatch.setattr(experiment, "run", lambda *_, **options: (asked.append(options), (report, ()))[1])
    assert cli.main(["eval", "merge", "--seeds", "2", "--first-seed", "7", "--cases", "repaved,1x1"]) == 0
    assert cli.main(["eval", "merge"]) == 0
    assert [list(options["seeds"]) for options in asked] == [[7, 8], list(range(12))]
    assert [options["cases"] for options in asked] == [select(["repaved", "1x1"]), CASES]


@pytest.mark.slow
def test_the_command_runs_from_end_to_end_and_draws(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    from evaluation.maps import cases

    kinds = ("parked_bad_machine", "repaved", "narrow_road", "slope_15")  # each has a picture of its own kind
    monkeypatch.setattr(cases, "CASES", [small(kind) for kind in kinds])
    words = ["eval", "merge", "--seeds", "1", "--cases", ",".join(kinds)]
    words += ["--out", str(tmp_path), "--processes", "1", "--plots", str(tmp_path / "plots"), "--json"]
    assert cli.main(words) == 0
    report = json.loads(capsys.readouterr().out)
    assert len(report["rows"]) == len(kinds) * len(METHODS)
    pictures = [tmp_path / "plots" / f"{name}.png" for name in ("table", *(small(kind).name for kind in kinds))]
    assert report["plots"] == [str(path) for path in pictures]
    assert all(path.stat().st_size > 10_000 for path in pictures)
