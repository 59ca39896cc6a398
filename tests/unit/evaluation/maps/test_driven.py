"""Maps judged where machines truly drove."""

import numpy as np
import pytest

from evaluation.maps.borders import BorderBin, by_border_distance
from evaluation.maps.score import driven_cells, score_driven
from protocol.queries.answers import Region
from protocol.site.ground_classes import UNKNOWN

NAN = np.nan


def region(resistance, grade_east=0.0, west_m: float = 100.0) -> Region:
    values = np.array(resistance, np.float32)
    rows, columns = values.shape
    flat = np.where(np.isfinite(values), np.float32(grade_east), np.float32(NAN))
    layers = {"resistance": values, "grade_east": flat, "grade_north": flat * 0}
    return Region(west_m + np.arange(columns) + 0.5, np.arange(rows) + 0.5, 1.0, layers, merged=1, stamp_ns=1)


def truth(resistance):
    values = np.array(resistance)
    return {"resistance": values, "grade_east": values * 0, "grade_north": values * 0}


TRUE = truth([[0.04, 0.04, 0.04, 0.06, 0.06, 0.06]] * 2)


def test_a_track_passes_cells_between_its_points():
    track = np.array([[100.5, 0.5], [103.5, 0.5], [103.5, 1.5]])
    passed = driven_cells(region([[NAN] * 6] * 2), [track])
    assert passed.tolist() == [[True, True, True, True, False, False], [False, False, False, True, False, False]]


def test_tracks_beyond_the_region_are_cut_and_those_of_all_machines_count():
    tracks = [np.array([[98.0, 0.5], [101.5, 0.5]]), np.array([[105.5, 1.5]]), np.empty((0, 2))]
    passed = driven_cells(region([[NAN] * 6] * 2), tracks)
    assert passed.sum() == 3
    assert passed[1, 5]


def test_only_cells_that_were_truly_driven_count():
    """Row 1 was never driven: its wrong cells are the position's fault."""
    estimated = region([[0.04, 0.04, 0.06, 0.06, NAN, 0.06], [0.25] * 6])
    score = score_driven(estimated, TRUE, [np.array([[100.5, 0.5], [105.5, 0.5]])])
    assert score.cells == 6
    assert score.known_pct == pytest.approx(100 * 5 / 6)
    assert score.wrong_resistance_pct == pytest.approx(100 * 1 / 5)
    assert score.wrong_grade_pct == 0.0
    near = score.by_border[0]
    assert near == BorderBin(0, 1, 2, 100, 50)
    assert [part.cells for part in score.by_border] == [2, 2, 2, 0, 0, 0, 0]
    assert score.by_border[1].known_pct == 50.0
    assert score.by_border[-1].to_m is None
    assert np.isnan(score.by_border[-1].wrong_pct)


def test_a_slope_that_is_none_is_wrong():
    estimated = region([[0.04] * 6] * 2, grade_east=0.3)
    assert score_driven(estimated, TRUE, [np.array([[100.5, 0.5], [105.5, 0.5]])]).wrong_grade_pct == 100.0


def test_a_site_that_nobody_drove_has_no_score():
    score = score_driven(region([[0.04] * 6] * 2), TRUE, [])
    assert score.cells == 0
    assert np.isnan([score.known_pct, score.wrong_resistance_pct]).all()


def test_cells_without_truth_do_not_count():
    cut = truth([[0.04, 0.04, NAN]])
    score = score_driven(region([[0.04, 0.06, 0.06]]), cut, [np.array([[100.5, 0.5], [102.5, 0.5]])])
    assert (score.cells, score.wrong_resistance_pct) == (2, 50.0)
    assert score.by_border[-1].cells == 2  # what is not known is no border


def test_distance_counts_from_the_lower_edge_of_a_bin():
    estimated, true = np.array([1, 1, UNKNOWN]), np.array([1, 2, 2])
    parts = by_border_distance(estimated, true, np.array([0.99, 1.0, np.inf]))
    assert [part.cells for part in parts] == [1, 1, 0, 0, 0, 0, 1]
    assert (parts[0].wrong_pct, parts[1].wrong_pct, parts[6].known_pct) == (0.0, 100.0, 0.0)
