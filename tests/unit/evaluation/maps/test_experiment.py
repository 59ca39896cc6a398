"""The comparison of merges: judged where machines drove, kept, resumed, through the command line; and its pictures."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from evaluation.maps import experiment
from evaluation.maps.cases import CASES, Machine, lay, select
from evaluation.maps.samples import Scene
from protocol.errors import SitegridError
from sitegrid import cli
from tests.paths import ROOT

METHODS = ["soft_votes", "last_write", "mean", "median", "kalman"]
KEYS = {
    "case", "passes_after", "width_m", "method", "wrong_pct", "wrong_min_pct", "wrong_max_pct", "known_pct",
    "changed_wrong_pct", "unchanged_wrong_pct", "near_wrong_pct", "share60_wrong_pct", "share60_cells_pct", "seconds",
    "samples", "cells", "distrusted", "wrong_by_seed_pct",
}  # fmt: skip
SMALL = tuple(replace(case, columns=45, rows=30) for case in CASES)


def small(name: str):
    return next(case for case in SMALL if case.name == name)


def plan(cache: Path, *names: str, seeds=(3, 4)) -> experiment.Plan:
    return experiment.Plan(seeds, cache, processes=1, cases=tuple(small(name) for name in names))


def scene_of(case, driven=None) -> Scene:
    site = lay(case)
    return Scene((), site, None, np.ones(site.c_rr.shape, bool) if driven is None else driven)


def test_every_case_and_method_has_a_row_with_all_keys(tmp_path: Path):
    everything = experiment.Plan((3,), tmp_path, processes=1, cases=SMALL)
    said: list[tuple[float, float, str]] = []
    report = experiment.run(everything, lambda *words: said.append(words))
    assert [(row["case"], row["method"]) for row in report["rows"]] == [(c.name, m) for c in CASES for m in METHODS]
    assert all(set(row) == KEYS for row in report["rows"])
    assert report["seeds"] == [3]
    assert len(said) == len(CASES)
    assert said[-1][0] == pytest.approx(said[-1][1])
    assert len(report["goals"]) == len(experiment.GOALS)
    for row in report["rows"]:
        server = row["method"] == "soft_votes"
        assert (row["changed_wrong_pct"] is None) == (row["passes_after"] is None) == (row["case"] != "repaved")
        assert (row["unchanged_wrong_pct"] is None) == (row["case"] != "repaved")
        assert (row["near_wrong_pct"] is None) == (row["case"] != "parked_bad_machine")
        assert (row["width_m"] is None) == (row["case"] != "narrow_road")
        assert (row["share60_cells_pct"] is None) == (not server or row["case"] in ("grade_both_ways", "slope_15"))
        assert 0 <= row["wrong_min_pct"] <= row["wrong_pct"] <= row["wrong_max_pct"]
        assert row["known_pct"] > 50
        assert row["samples"] > row["cells"] > 0
    assert json.loads(json.dumps(report, allow_nan=False)) == report


def test_rows_are_medians_over_seeds():
    outcomes = [
        {
            "samples": n,
            "cells": 8,
            "distrusted": [],
            "methods": {"mean": {"wrong_pct": w, "known_pct": 50.0, "seconds": 1.0}},
        }
        for n, w in ((10, 1.0), (30, 4.0), (20, 2.0))
    ]
    row = experiment.summarise(small("1x1"), "mean", outcomes)
    assert (row["wrong_pct"], row["wrong_min_pct"], row["wrong_max_pct"]) == (2.0, 1.0, 4.0)
    assert row["wrong_by_seed_pct"] == [1.0, 4.0, 2.0]
    assert (row["samples"], row["known_pct"], row["near_wrong_pct"], row["distrusted"]) == (20, 50.0, None, None)


def test_machines_that_the_server_left_out_are_counted_over_seeds():
    figures = {"wrong_pct": 1.0, "known_pct": 50.0, "seconds": 1.0}
    outcomes = [
        {"samples": 1, "cells": 8, "distrusted": names, "methods": {"soft_votes": figures}}
        for names in (["b"], [], ["b", "a"])
    ]
    assert experiment.summarise(small("1x1"), "soft_votes", outcomes)["distrusted"] == {"a": 1, "b": 2}


def test_a_map_of_the_truth_is_right_and_only_driven_cells_count():
    case = small("1x1")
    driven = np.zeros((30, 45), bool)
    driven[:2] = True
    scene = scene_of(case, driven)
    found = scene.site.c_rr_later.copy()
    found[10:] = 0.25
    assert experiment.figures(case, scene, {"resistance": found}) == {"wrong_pct": 0.0, "known_pct": 100.0}
    found[0, :9], found[1] = 0.25, np.nan
    figures = experiment.figures(case, scene, {"resistance": found})
    assert figures == {"wrong_pct": pytest.approx(100 * 9 / 45), "known_pct": 50.0}


def test_changed_and_unchanged_cells_are_judged_apart_by_how_the_site_was_left():
    case = small("repaved")
    scene = scene_of(case)
    figures = experiment.figures(case, scene, {"resistance": scene.site.c_rr})
    assert (figures["changed_wrong_pct"], figures["unchanged_wrong_pct"]) == (100.0, 0.0)
    assert figures["wrong_pct"] == pytest.approx(100 * scene.site.repaved.mean())
    left = experiment.figures(case, scene, {"resistance": scene.site.c_rr_later})
    assert left["changed_wrong_pct"] == 0.0


def test_of_a_narrow_road_only_the_road_is_judged():
    case = small("narrow_road")
    scene = scene_of(case)
    assert experiment.figures(case, scene, {"resistance": np.full((30, 45), 0.008)})["wrong_pct"] == 0.0
    assert experiment.figures(case, scene, {"resistance": np.full((30, 45), 0.06)})["wrong_pct"] == 100.0


def test_cells_beside_a_parked_machine_are_judged_apart():
    case = replace(small("parked_bad_machine"), columns=90, rows=60)
    near = experiment.near_parked(case)
    assert near.sum() == pytest.approx(np.pi * experiment.NEAR_M**2, rel=0.1)
    assert near[15, 70]  # three metres east of where it truly stands
    assert not near[15, 65]
    scene = scene_of(case)
    found = np.where(near, 0.06, scene.site.c_rr)
    assert experiment.figures(case, scene, {"resistance": found})["near_wrong_pct"] == 100.0
    assert not experiment.near_parked(replace(case, machines=(Machine(),))).any()


def test_sure_cells_are_judged_apart():
    case = small("1x1")
    scene = scene_of(case)
    found, confidence = scene.site.c_rr.copy(), np.full((30, 45), 0.9)
    found[0], confidence[0] = 0.25, 0.59
    figures = experiment.figures(case, scene, {"resistance": found, "confidence": confidence})
    assert figures["share60_wrong_pct"] == 0.0
    assert figures["share60_cells_pct"] == pytest.approx(100 * 29 / 30)
    confidence[0] = 0.6
    assert experiment.figures(case, scene, {"resistance": found, "confidence": confidence})["share60_wrong_pct"] > 0


def test_a_gradient_is_wrong_if_its_vector_is_off_by_more_than_a_percent():
    case = small("slope_15")
    scene = scene_of(case)
    east, north = np.moveaxis(scene.site.gradient, -1, 0)
    assert (
        experiment.figures(case, scene, {"grade_east": east + 0.007, "grade_north": north + 0.007})["wrong_pct"] == 0.0
    )
    assert (
        experiment.figures(case, scene, {"grade_east": east + 0.008, "grade_north": north - 0.008})["wrong_pct"]
        == 100.0
    )
    unknown = np.where(np.arange(45) < 9, np.nan, east)
    assert experiment.figures(case, scene, {"grade_east": unknown, "grade_north": north})["known_pct"] == pytest.approx(
        80
    )


def test_goals_are_met_or_not_and_what_is_not_known_is_not():
    rows = [
        {"case": "1x1", "wrong_pct": 0.4, "share60_wrong_pct": None},
        {"case": "repaved", "passes_after": 1, "changed_wrong_pct": 2.0, "unchanged_wrong_pct": 0.1},
        {"case": "repaved", "passes_after": 2, "changed_wrong_pct": 1.0, "unchanged_wrong_pct": 0.1},
        {"case": "4x4", "method": "last_write", "wrong_pct": 0.5},
    ]
    rows = [{"method": "soft_votes", "passes_after": None, **row} for row in rows]
    met = {(goal["row"], goal["name"], goal["goal"]): goal["met"] for goal in experiment.goals(rows)}
    assert met == {
        ("1x1 soft_votes", "wrong_pct", "<= 0.4"): True,
        ("1x1 soft_votes", "share60_wrong_pct", "<= 0.2"): False,
        ("repaved 1 soft_votes", "changed_wrong_pct", "<= 1.5"): False,
        ("repaved 1 soft_votes", "unchanged_wrong_pct", "<= 0.2"): True,
        ("4x4 last_write", "wrong_pct", ">= 0.7"): False,
        ("4x4 last_write", "wrong_pct", "<= 1.4"): True,
    }


def test_an_interrupted_run_goes_on_where_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    asked = plan(tmp_path, "1x1", "slope_15")
    first = experiment.run(asked)
    gone = experiment.Task(small("slope_15"), 4, tmp_path)
    experiment.result_file(gone).unlink()
    done = []
    work = experiment.solve
    monkeypatch.setattr(experiment, "solve", lambda case, seed: (done.append((case.name, seed)), work(case, seed))[1])
    again = experiment.run(asked)
    assert done == [("slope_15", 4)]
    for report in (first, again):
        for row in report["rows"]:
            row.pop("seconds")
    assert first == again
    assert not list(tmp_path.rglob("*.part"))


def test_other_code_and_other_cases_have_other_results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    task = experiment.Task(small("1x1"), 3, tmp_path)
    wider = replace(task, case=replace(task.case, columns=46))
    assert len({experiment.result_file(t) for t in (task, wider, replace(task, seed=4))}) == 3
    before = experiment.result_file(task)
    monkeypatch.setattr(experiment, "code_version", lambda *_: "another")
    assert experiment.result_file(task) != before
    with pytest.raises(SitegridError, match="sources changed"):
        experiment._work((task, before))


def test_results_depend_on_the_server_and_on_everything_that_makes_samples():
    for source in experiment.SOURCES:
        assert (ROOT / source).exists()
    assert {"mapserver", "protocol", "evaluation/maps/samples.py"} <= set(experiment.SOURCES)


def test_worker_processes_find_what_one_process_finds(tmp_path: Path):
    one = experiment.run(plan(tmp_path / "one", "1x1", seeds=(3, 4)))
    two = experiment.run(replace(plan(tmp_path / "two", "1x1", seeds=(3, 4)), processes=2))
    assert [row["wrong_by_seed_pct"] for row in one["rows"]] == [row["wrong_by_seed_pct"] for row in two["rows"]]


# --- the command -----------------------------------------------------------------------------------------------------


def test_options_become_a_plan(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    plans: list[experiment.Plan] = []
    monkeypatch.setattr(experiment, "run", lambda asked, _: (plans.append(asked), {"rows": [{"wrong_pct": None}]})[1])
    words = ["eval", "merge", "--seeds", "2", "--first-seed", "7", "--cases", "repaved,1x1", "--out", "x"]
    assert cli.main([*words, "--processes", "3", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"rows": [{"wrong_pct": None}]}
    assert cli.main(["eval", "merge"]) == 0
    asked, default = plans
    assert (asked.seeds, asked.cache, asked.processes) == ((7, 8), Path("x"), 3)
    assert asked.cases == select(["repaved", "1x1"])
    assert (default.seeds, default.cases) == (tuple(range(12)), CASES)


def test_an_unknown_case_is_one_line(capsys: pytest.CaptureFixture[str]):
    assert cli.main(["eval", "merge", "--cases", "1x1,2x2"]) == 1
    error = capsys.readouterr().err
    assert error.startswith("sitegrid: --cases: `2x2` is not known; known: 1x1, 1x4, 4x4, bad_machine,")
    assert error.count("\n") == 1


def test_the_command_runs_from_end_to_end_and_draws(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    from evaluation.maps import cases

    names = ("parked_bad_machine", "repaved", "narrow_road", "slope_15")  # each has a picture of its own kind
    monkeypatch.setattr(cases, "CASES", [small(name) for name in names])
    words = ["eval", "merge", "--seeds", "1", "--cases", ",".join(names)]
    words += ["--out", str(tmp_path), "--processes", "1", "--plots", str(tmp_path / "plots"), "--json"]
    assert cli.main(words) == 0
    report = json.loads(capsys.readouterr().out)
    assert len(report["rows"]) == len(names) * len(METHODS)
    pictures = [tmp_path / "plots" / f"{name}.png" for name in ("table", *(small(name).file_name for name in names))]
    assert report["plots"] == [str(path) for path in pictures]
    assert all(path.stat().st_size > 10_000 for path in pictures)
