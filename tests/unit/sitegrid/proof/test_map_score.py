"""Maps against the truth: all known cells, and truly driven ones."""

import math
from pathlib import Path

import numpy as np
import pytest

from protocol.queries.answers import Region
from protocol.site.ground_classes import SLOPE_LIMIT
from protocol.wire.messages import Pose
from sitegrid.proof.figures import root_mean_square
from sitegrid.proof.map_score import driven_cells, score, score_driven
from sitegrid.proof.tracks import Truth, position_rmse, read_track
from tests.unit.records import version

NAN = np.nan


def region(resistance, east=0.0, north=0.0, west_m: float = 100.0) -> Region:
    """Slopes are unknown where resistance is."""
    values = np.array(resistance, np.float32)
    slopes = (np.where(np.isfinite(values), np.float32(slope), np.float32(NAN)) for slope in (east, north))
    layers = dict(zip(("resistance", "grade_east", "grade_north"), (values, *slopes), strict=True))
    rows, columns = values.shape
    return Region(west_m + np.arange(columns) + 0.5, np.arange(rows) + 0.5, 1.0, layers, version=version(1), stamp_ns=1)


TRUE = region([[0.04, 0.04, 0.04, 0.06, 0.06, 0.06]] * 2)
NOTHING = region([[NAN] * 6] * 2)
ROW_0 = [np.array([[100.5, 0.5], [105.5, 0.5]])]


def test_wrong_cells_are_counted_among_the_known():
    estimated = region([[0.008, 0.02, 0.04], [0.25, 0.06, NAN]], [[0.0] * 3, [0.3, 0.0, 0.0]], [[0.0] * 3, [0, 0.3, 0]])
    truth = region(
        [[0.012, 0.02, 0.06], [0.25, 0.06, 0.008]], [[0.0] * 3, [0.3, 0.3, 0.0]], [[0.0, 0.3, 0.0], [0.0] * 3]
    )
    result = score(estimated, truth)
    assert result.cells == 5
    assert result.wrong_resistance_pct == pytest.approx(20.0)  # 0.04 is dry dirt, 0.06 wet dirt
    assert result.wrong_grade_pct == pytest.approx(20.0)  # a missed slope; a reversed one is still a slope


def test_a_perfect_map_scores_zero_and_an_unknown_one_has_no_score():
    here = region([[0.008, 0.25]], [[0.2, 0.0]], [[0.0, -0.2]])
    result, unknown = score(here, here), score(NOTHING, TRUE)
    assert (result.cells, result.wrong_resistance_pct, result.wrong_grade_pct) == (2, 0.0, 0.0)
    assert unknown.cells == 0
    assert np.isnan([unknown.wrong_resistance_pct, unknown.wrong_grade_pct]).all()


@pytest.mark.parametrize(("share", "wrong"), [(0.99, 100.0), (1.01, 0.0)])
def test_slope_begins_at_the_papers_limit(share, wrong):
    estimated, truth = region([[0.02]], SLOPE_LIMIT * share), region([[0.02]], 0.27)
    assert score(estimated, truth).wrong_grade_pct == wrong
    assert score_driven(estimated, truth, ROW_0).wrong_grade_pct == wrong


def test_a_track_passes_cells_between_its_points():
    passed = driven_cells(NOTHING, [np.array([[100.5, 0.5], [103.5, 0.5], [103.5, 1.5]])])
    assert passed.tolist() == [[True, True, True, True, False, False], [False, False, False, True, False, False]]


def test_tracks_beyond_the_region_are_cut_and_those_of_all_machines_count():
    tracks = [np.array([[98.0, 0.5], [101.5, 0.5]]), np.array([[105.5, 1.5]]), np.empty((0, 2))]
    passed = driven_cells(NOTHING, tracks)
    assert passed.sum() == 3
    assert passed[1, 5]


def test_only_cells_that_were_truly_driven_count():
    """Row 1 was never driven: position errors."""
    result = score_driven(region([[0.04, 0.04, 0.06, 0.06, NAN, 0.06], [0.25] * 6]), TRUE, ROW_0)
    assert (result.cells, result.wrong_grade_pct) == (6, 0.0)
    assert result.known_pct == pytest.approx(100 * 5 / 6)
    assert result.wrong_resistance_pct == pytest.approx(100 * 1 / 5)
    near, far = result.by_border[0], result.by_border[-1]
    assert near == {"from_m": 0, "to_m": 1, "cells": 2, "known_pct": 100, "wrong_pct": 50}
    assert [part["cells"] for part in result.by_border] == [2, 2, 2, 0, 0, 0, 0]
    assert result.by_border[1]["known_pct"] == 50.0
    assert far["to_m"] is None
    assert np.isnan(far["wrong_pct"])


def test_cells_without_truth_do_not_count():
    estimated, truth = region([[0.04, 0.06, 0.06]]), region([[0.04, 0.04, NAN]])
    whole, driven = score(estimated, truth), score_driven(estimated, truth, ROW_0)
    assert (whole.wrong_resistance_pct, whole.wrong_grade_pct) == (50.0, 0.0)
    assert (driven.cells, driven.wrong_resistance_pct) == (2, 50.0)
    assert driven.by_border[-1]["cells"] == 2  # unknown is no border


def test_root_mean_square_of_nothing_is_not_known():
    assert root_mean_square(np.array([3.0, -4.0])) == pytest.approx(math.sqrt(12.5))
    assert math.isnan(root_mean_square(np.empty(0)))


START_NS = 1_767_225_600_000_000_000


def pose(name: str, seconds: float, x_m: float, y_m: float) -> Pose:
    return Pose(name, START_NS + round(seconds * 1e9), x_m, y_m, 0.0, 1.0, 1.0, 0.0, 1.0)


@pytest.fixture
def truth(tmp_path: Path) -> Path:
    """Machine `a` drives east at 2 m/s, machine `b` stands at (5, -5)."""
    (tmp_path / "tracks").mkdir()
    for name, place in (("a", lambda t: (2.0 * t, 0.0)), ("b", lambda _: (5.0, -5.0))):
        lines = [f"{START_NS + t * 10**9},{place(t)[0]},{place(t)[1]}" for t in range(11)]
        (tmp_path / "tracks" / f"{name}.csv").write_text("\n".join(["stamp_ns,x,y", *lines]) + "\n")
    return tmp_path


def test_error_is_the_root_mean_square_in_the_plane(truth):
    poses = {
        "a": [pose("a", 1.0, 2.0 + 3.0, 4.0), pose("a", 2.0, 4.0, 0.0)],  # 5 m and 0 m off
        "b": [pose("b", t, 5.0, -7.0) for t in range(10)],
    }
    assert position_rmse(poses, truth) == pytest.approx({"a": (25 / 2) ** 0.5, "b": 2.0}, abs=1e-5)


def test_truth_is_interpolated_and_unknown_beyond_its_ends():
    truth = Truth(START_NS + np.array([0, 10**9]), np.array([[0.0, 5.0], [4.0, 5.0]]))
    places = truth.at(START_NS + np.array([-1, 0, 250_000_000, 10**9, 10**9 + 1]))
    assert places[1:4] == pytest.approx(np.array([[0.0, 5.0], [1.0, 5.0], [4.0, 5.0]]))
    assert np.isnan(places[[0, 4]]).all()


def test_track_of_a_simulation_keeps_exact_stamps(tmp_path: Path):
    (tmp_path / "a.csv").write_text(f"stamp_ns,x,y,z\n{START_NS + 1},1.5,2.5,0\n{START_NS + 100_000_001},2.5,3.5,0\n")
    truth = read_track(tmp_path / "a.csv")
    assert truth.stamp_ns.tolist() == [START_NS + 1, START_NS + 100_000_001]
    assert truth.position_m.tolist() == [[1.5, 2.5], [2.5, 3.5]]
