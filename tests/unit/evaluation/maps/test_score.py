import numpy as np
import pytest

from evaluation.maps.score import score
from protocol.queries.answers import Region
from protocol.site.ground_classes import SLOPE_LIMIT

NAN = np.nan


def region(resistance, east, north) -> Region:
    layers = {"resistance": resistance, "grade_east": east, "grade_north": north}
    arrays = {name: np.array(values, np.float32) for name, values in layers.items()}
    rows, columns = arrays["resistance"].shape
    return Region(np.arange(columns) + 0.5, np.arange(rows) + 0.5, 1.0, arrays, merged=1, stamp_ns=1)


def test_wrong_cells_are_counted_among_the_known():
    estimated = region(
        [[0.008, 0.02, 0.04], [0.25, 0.06, NAN]], [[0.0] * 3, [0.3, 0.0, NAN]], [[0.0] * 3, [0.0, 0.3, NAN]]
    )
    truth = {
        "resistance": np.array([[0.012, 0.02, 0.06], [0.25, 0.06, 0.008]]),
        "grade_east": np.array([[0.0, 0.0, 0.0], [0.3, 0.3, 0.0]]),
        "grade_north": np.array([[0.0, 0.3, 0.0], [0.0, 0.0, 0.0]]),
    }
    result = score(estimated, truth)
    assert result.cells == 5
    assert result.wrong_resistance_pct == pytest.approx(20.0)  # 0.04 is dry dirt, 0.06 wet dirt
    assert result.wrong_grade_pct == pytest.approx(20.0)  # a slope missed; one turned round is still a slope


def test_a_perfect_map_scores_zero():
    here = region([[0.008, 0.25]], [[0.2, 0.0]], [[0.0, -0.2]])
    result = score(here, here)
    assert (result.cells, result.wrong_resistance_pct, result.wrong_grade_pct) == (2, 0.0, 0.0)


def test_an_unknown_map_has_no_score():
    nothing = region([[NAN]], [[NAN]], [[NAN]])
    result = score(nothing, region([[0.02]], [[0.0]], [[0.0]]))
    assert result.cells == 0
    assert np.isnan([result.wrong_resistance_pct, result.wrong_grade_pct]).all()


def test_cells_without_truth_do_not_count():
    estimated = region([[0.008, 0.25]], [[0.0, 0.0]], [[0.0, 0.0]])
    result = score(estimated, region([[0.008, NAN]], [[0.0, NAN]], [[0.0, 0.0]]))
    assert (result.wrong_resistance_pct, result.wrong_grade_pct) == (0.0, 0.0)


@pytest.mark.parametrize(("share", "wrong"), [(0.99, 100.0), (1.01, 0.0)])
def test_slope_begins_at_the_papers_limit(share, wrong):
    estimated = region([[0.02]], [[SLOPE_LIMIT * share]], [[0.0]])
    truth = region([[0.02]], [[0.27]], [[0.0]])
    assert score(estimated, truth).wrong_grade_pct == wrong
