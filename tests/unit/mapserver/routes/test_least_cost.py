"""Least-cost lines against known answers and a search with 64 neighbours."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from mapserver.routes.grid_search import LEAST_COST
from mapserver.routes.least_cost import CostField, cost_of, least_cost_line, reaches
from tests.reference.least_cost import least_cost


def even(size: int = 100, resistance: float = 0.02, crawl: float = math.inf) -> CostField:
    flat = np.zeros((size, size))
    return CostField(flat + resistance, flat, flat, np.ones((size, size), bool), 1.0, crawl)


def rough(seed: int, size: int = 120) -> CostField:
    """Hills with patches of sand and paved ground."""
    rng = np.random.default_rng(seed)
    height = gaussian_filter(rng.standard_normal((size, size)), 20)
    north, east = np.gradient(6 * height / height.std())
    patches = gaussian_filter(rng.standard_normal((size, size)), 8)
    patches /= patches.std()
    resistance = np.select([patches > 1.4, patches > 0.6, patches < -1.0], [0.25, 0.06, 0.012], 0.03)
    return CostField(resistance, east, north, np.ones((size, size), bool), 1.0)


def line_of(terrain: CostField, start: tuple[int, int], end: tuple[int, int]) -> tuple[np.ndarray, float]:
    result = least_cost_line(terrain, start, end)
    assert result
    return result


@pytest.mark.parametrize("end", [(90, 5), (93, 41), (17, 95)])
def test_on_even_ground_the_line_is_straight(end: tuple[int, int]) -> None:
    line, cost = line_of(even(), (5, 5), end)
    assert cost == pytest.approx(0.02 * math.dist((5, 5), end), rel=1e-9)
    assert line[[0, -1]].tolist() == [[5, 5], list(end)]
    assert len(line) == 2


def test_no_line_is_dearer_than_with_64_neighbours() -> None:
    """Random maps: at most 2 % at worst, 1 % median."""
    ratios = []
    for seed in range(6):
        terrain = rough(seed)
        ends = np.random.default_rng(seed).integers(0, 120, (2, 2))
        start, end = (tuple(cell) for cell in ends.tolist())
        if math.dist(start, end) < 40:
            continue
        line, cost = line_of(terrain, start, end)
        assert cost == pytest.approx(cost_of(terrain, line))
        ratios.append(cost / least_cost(terrain, start, end))
    assert len(ratios) >= 4
    assert np.median(ratios) < 1.01
    assert max(ratios) < 1.02


def test_downhill_costs_something_everywhere() -> None:
    """Else settled cells would need settling again, and distances be silently wrong."""
    terrain = replace(even(), grade_east=np.full((100, 100), -0.3))
    line, cost = line_of(terrain, (50, 10), (50, 90))
    assert cost == pytest.approx(LEAST_COST * 80)
    assert len(line) == 2
    assert line_of(terrain, (50, 90), (50, 10))[1] == pytest.approx((0.02 + 0.3) * 80)
    hills = replace(rough(3), grade_east=3 * rough(3).grade_east)
    assert line_of(hills, (10, 10), (100, 90))[1] <= 1.02 * least_cost(hills, (10, 10), (100, 90))


def test_no_line_leads_over_what_is_not_open_nor_between_two_cells_that_touch_by_a_corner() -> None:
    wall = np.ones((40, 40), bool)
    wall[:, 20] = False
    closed = replace(even(40), is_open=wall)
    assert least_cost_line(closed, (5, 5), (5, 35)) is None
    assert not reaches(closed, (5, 5), (5, 35))
    diagonal = ~np.eye(40, dtype=bool)
    assert least_cost_line(replace(even(40), is_open=diagonal), (5, 30), (30, 5)) is None
    wall[33, 20] = True
    line, _ = line_of(replace(even(40), is_open=wall), (5, 5), (5, 35))
    assert [33, 20] in line.tolist()
    assert reaches(replace(even(40), is_open=wall), (5, 5), (5, 35))
