"""Figures of maps that are right or wrong where they are meant to be."""

from dataclasses import replace

import numpy as np
import pytest

from evaluation.maps.cases import CASES, CaseMachine, MapCase, build_site
from evaluation.maps.figures import NEAR_M, MapFigures, figures, near_parked
from evaluation.maps.samples import MapScene


def small(kind: str) -> MapCase:
    return replace(next(case for case in CASES if case.kind == kind), columns=45, rows=30)


def scene_of(case: MapCase, driven=None) -> MapScene:
    site = build_site(case)
    return MapScene((), site, None, np.ones(site.c_rr.shape, bool) if driven is None else driven)


def test_a_map_of_the_truth_is_right_and_only_driven_cells_count():
    case = small("1x1")
    driven = np.zeros((30, 45), bool)
    driven[:2] = True
    scene = scene_of(case, driven)
    estimated = scene.site.c_rr_later.copy()
    estimated[10:] = 0.25
    assert figures(case, scene, {"resistance": estimated}) == MapFigures(wrong_pct=0.0, known_pct=100.0)
    estimated[0, :9], estimated[1] = 0.25, np.nan
    judged = figures(case, scene, {"resistance": estimated})
    assert (judged.wrong_pct, judged.known_pct) == (pytest.approx(100 * 9 / 45), 50.0)


def test_changed_and_unchanged_cells_are_judged_apart_by_how_the_site_was_left():
    case = small("repaved")
    scene = scene_of(case)
    judged = figures(case, scene, {"resistance": scene.site.c_rr})
    assert (judged.changed_wrong_pct, judged.unchanged_wrong_pct) == (100.0, 0.0)
    assert judged.wrong_pct == pytest.approx(100 * scene.site.repaved.mean())
    left = figures(case, scene, {"resistance": scene.site.c_rr_later})
    assert left.changed_wrong_pct == 0.0


def test_of_a_narrow_road_only_the_road_is_judged():
    case = small("narrow_road")
    scene = scene_of(case)
    assert figures(case, scene, {"resistance": np.full((30, 45), 0.008)}).wrong_pct == 0.0
    assert figures(case, scene, {"resistance": np.full((30, 45), 0.06)}).wrong_pct == 100.0


def test_cells_beside_a_parked_machine_are_judged_apart():
    case = replace(small("parked_bad_machine"), columns=90, rows=60)
    near = near_parked(case)
    assert near.sum() == pytest.approx(np.pi * NEAR_M**2, rel=0.1)
    assert near[15, 70]  # three metres east of where it truly stands
    assert not near[15, 65]
    scene = scene_of(case)
    estimated = np.where(near, 0.06, scene.site.c_rr)
    assert figures(case, scene, {"resistance": estimated}).near_wrong_pct == 100.0
    assert not near_parked(replace(case, machines=(CaseMachine(),))).any()


def test_sure_cells_are_judged_apart():
    case = small("1x1")
    scene = scene_of(case)
    estimated, confidence = scene.site.c_rr.copy(), np.full((30, 45), 0.9)
    estimated[0], confidence[0] = 0.25, 0.59
    judged = figures(case, scene, {"resistance": estimated, "confidence": confidence})
    assert judged.share60_wrong_pct == 0.0
    assert judged.share60_cells_pct == pytest.approx(100 * 29 / 30)
    confidence[0] = 0.6
    assert figures(case, scene, {"resistance": estimated, "confidence": confidence}).share60_wrong_pct > 0


def test_a_gradient_is_wrong_if_its_vector_is_off_by_more_than_a_percent():
    case = small("slope_15")
    scene = scene_of(case)
    east, north = np.moveaxis(scene.site.gradient, -1, 0)
    assert figures(case, scene, {"grade_east": east + 0.007, "grade_north": north + 0.007}).wrong_pct == 0.0
    assert figures(case, scene, {"grade_east": east + 0.008, "grade_north": north - 0.008}).wrong_pct == 100.0
    unknown = np.where(np.arange(45) < 9, np.nan, east)
    assert figures(case, scene, {"grade_east": unknown, "grade_north": north}).known_pct == pytest.approx(80)
