"""Comparison of merges: figures of maps with known errors, and rows."""

from dataclasses import replace

import numpy as np
import pytest

from lab.maps import experiment
from lab.maps.cases import CASES, CaseMachine, MapCase, build_site
from lab.maps.experiment import NEAR_M, CaseResult, figures, near_parked
from lab.maps.samples import MapScene

SMALL = tuple(replace(case, columns=45, rows=30) for case in CASES)
NONE = dict.fromkeys(experiment.FIGURES)
FIGURES = {**NONE, "wrong_pct": 1.0, "known_pct": 50.0, "seconds": 1.0}


def small(kind: str) -> MapCase:
    return next(case for case in SMALL if case.kind == kind)


def scene_of(kind: str) -> tuple[MapCase, MapScene]:
    """A small, completely driven case."""
    site = build_site(small(kind))
    return small(kind), MapScene((), site, None, np.ones(site.c_rr.shape, bool))


def test_a_map_of_the_truth_is_right_and_only_driven_cells_count():
    case, scene = scene_of("1x1")
    scene.driven[2:] = False
    estimated = scene.site.c_rr_later.copy()
    estimated[10:] = 0.25
    assert figures(case, scene, {"resistance": estimated}) == {**NONE, "wrong_pct": 0.0, "known_pct": 100.0}
    estimated[0, :9], estimated[1] = 0.25, np.nan
    judged = figures(case, scene, {"resistance": estimated})
    assert (judged["wrong_pct"], judged["known_pct"]) == (pytest.approx(100 * 9 / 45), 50.0)


def test_changed_and_unchanged_cells_are_judged_apart_by_how_the_site_was_left():
    case, scene = scene_of("repaved")
    judged = figures(case, scene, {"resistance": scene.site.c_rr})
    assert (judged["changed_wrong_pct"], judged["unchanged_wrong_pct"]) == (100.0, 0.0)
    assert judged["wrong_pct"] == pytest.approx(100 * scene.site.repaved.mean())
    left = figures(case, scene, {"resistance": scene.site.c_rr_later})
    assert left["changed_wrong_pct"] == 0.0


def test_cells_beside_a_parked_machine_are_judged_apart():
    case, scene = scene_of("parked_bad_machine")
    near = near_parked(case)
    assert near.sum() == pytest.approx(np.pi * NEAR_M**2, rel=0.1)
    assert near[7, 36]  # 3 m east of its true place (33.75, 7.5)
    assert not near[7, 32]
    estimated = np.where(near, 0.06, scene.site.c_rr)
    assert figures(case, scene, {"resistance": estimated})["near_wrong_pct"] == 100.0
    assert not near_parked(replace(case, machines=(CaseMachine(),))).any()


def test_a_gradient_is_wrong_if_its_vector_is_off_by_more_than_a_percent():
    case, scene = scene_of("slope_15")
    east, north = np.moveaxis(scene.site.gradient, -1, 0)
    assert figures(case, scene, {"grade_east": east + 0.007, "grade_north": north + 0.007})["wrong_pct"] == 0.0
    assert figures(case, scene, {"grade_east": east + 0.008, "grade_north": north - 0.008})["wrong_pct"] == 100.0
    unknown = np.where(np.arange(45) < 9, np.nan, east)
    assert figures(case, scene, {"grade_east": unknown, "grade_north": north})["known_pct"] == pytest.approx(80)


# --- rows ------------------------------------------------------------------------------------------------------------


def test_rows_are_medians_over_seeds():
    results = [
        CaseResult(samples, 8, [], {"mean": {**FIGURES, "wrong_pct": wrong}})
        for samples, wrong in ((10, 1.0), (30, 4.0), (20, 2.00004))
    ]
    row = experiment.summarise(small("1x1"), "mean", results)
    assert (row["wrong_pct"], row["wrong_min_pct"], row["wrong_max_pct"]) == (2.0, 1.0, 4.0)
    assert row["wrong_by_seed_pct"] == [1.0, 4.0, 2.0]
    assert (row["samples"], row["known_pct"], row["near_wrong_pct"], row["distrusted"]) == (20, 50.0, None, None)
