"""Coarse maps depend on no order, and remember only the newest periods."""

import numpy as np
import pytest

from mapserver.trust.coarse_map import LEVEL_FLOOR, CoarseMap, Surface, map_cell_m, pooled
from protocol.arrays import Table
from tests.unit.mapserver.data import random_samples, samples


def surface_of(parts: list[Table]) -> Surface:
    coarse = CoarseMap(1.0)
    for part in parts:
        coarse.add(part)
    return coarse.surface()


def test_a_cell_keeps_its_metres_and_its_mean_level() -> None:
    surface = surface_of([samples(2, c_rr=[0.02, 0.04], distance_m=[1.0, 3.0])])
    assert surface.metres.tolist() == [4.0]
    expected = (np.log(0.02 + LEVEL_FLOOR) + 3 * np.log(0.04 + LEVEL_FLOOR)) / 4
    assert surface.level == pytest.approx([expected], abs=1e-3)
    assert surface.std_m == pytest.approx(0.1, abs=0.01)


def test_a_pooled_map_without_one_of_its_parts_is_the_map_of_the_rest() -> None:
    one, other = surface_of([random_samples(500, 1)]), surface_of([random_samples(500, 2)])
    rest = pooled([one, other]).without(one)
    assert np.array_equal(rest.codes, other.codes)
    assert np.array_equal(rest.sums, other.sums)
    assert len(pooled([]).codes) == 0


@pytest.mark.parametrize(("cell_m", "expected"), [(1.0, 2.0), (0.5, 2.0), (0.7, 2.1), (5.0, 5.0)])
def test_cells_are_whole_cells_of_the_site(cell_m: float, expected: float) -> None:
    assert map_cell_m(cell_m) == pytest.approx(expected)
