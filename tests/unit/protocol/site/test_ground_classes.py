import itertools
import math

import numpy as np
import pytest

from protocol.site.ground_classes import (
    BOUNDARIES,
    FLAT,
    SLOPE,
    UNKNOWN,
    ZONES,
    resistance_class,
    slope_class,
    wrong_percent,
)


def test_boundaries_are_midway_between_zones():
    midway = [(a.c_rr + b.c_rr) / 2 for a, b in itertools.pairwise(ZONES)]
    assert list(BOUNDARIES) == pytest.approx(midway)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_each_zone_is_its_own_class(dtype):
    values = np.array([*(zone.c_rr for zone in ZONES), np.nan, -0.5, 4.0, np.inf], dtype)
    assert resistance_class(values).tolist() == [0, 1, 2, 3, 4, UNKNOWN, 0, 4, UNKNOWN]


def test_slope_is_a_matter_of_steepness_not_direction():
    steep, gentle = math.tan(math.radians(7.6)), math.tan(math.radians(7.4))
    east = np.array([steep, -steep, 0.0, gentle, 0.0, np.nan, 0.5])
    north = np.array([0.0, 0.0, -steep, 0.0, 0.0, 0.0, np.nan])
    assert slope_class(east, north).tolist() == [SLOPE, SLOPE, SLOPE, FLAT, FLAT, UNKNOWN, UNKNOWN]


def test_wrong_percent_counts_cells_known_in_both():
    classes, truth = np.array([0, 1, 2, UNKNOWN, 1]), np.array([0, 1, 1, 1, UNKNOWN])
    assert wrong_percent(classes, truth) == pytest.approx(100 / 3)
    assert math.isnan(wrong_percent(np.array([UNKNOWN]), np.array([0])))
