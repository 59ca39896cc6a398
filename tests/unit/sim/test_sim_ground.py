import math

import numpy as np
import pytest

from sim import paper_site
from sim.paper_site import DEPTH_M, SLOPE_FOOT_M, SLOPE_TOP_M, TOURS, WIDTH_M
from sim.routes import rounded, speed_limits
from sim.soil import CONCRETE, DRY_DIRT, GRAVEL, SAND, SOILS, WET_DIRT
from sim.terrain import Terrain
from sim.truth import truth_map

SMOOTH = paper_site.terrain(0, 0.0)


def test_gradient_is_the_slope_of_the_height() -> None:
    rng = np.random.default_rng(1)
    terrain = Terrain(rng.standard_normal((20, 30)), 0.5, np.zeros((1, 1), np.int64), 1.0)
    # stay clear of the cells' edges, where the bilinear surface has kinks
    x = (rng.integers(0, 28, 100) + rng.uniform(0.1, 0.9, 100)) * 0.5
    y = (rng.integers(0, 18, 100) + rng.uniform(0.1, 0.9, 100)) * 0.5
    east, north = terrain.gradient(x, y)
    h = 1e-4
    np.testing.assert_allclose(east, (terrain.height(x + h, y) - terrain.height(x - h, y)) / (2 * h), atol=1e-8)
    np.testing.assert_allclose(north, (terrain.height(x, y + h) - terrain.height(x, y - h)) / (2 * h), atol=1e-8)


def test_height_passes_through_the_nodes() -> None:
    heights = np.random.default_rng(2).standard_normal((5, 7))
    terrain = Terrain(heights, 2.0, np.zeros((1, 1), np.int64), 1.0)
    x, y = np.meshgrid(np.arange(7) * 2.0, np.arange(5) * 2.0)
    np.testing.assert_allclose(terrain.height(x, y), heights, atol=1e-12)


def test_ground_continues_beyond_the_edges() -> None:
    outside = np.array([-50.0, 300.0]), np.array([-50.0, 300.0])
    np.testing.assert_allclose(SMOOTH.height(*outside), [0.0, 6.0], atol=1e-9)
    assert SMOOTH.zone(*outside).tolist() == [CONCRETE, WET_DIRT]


@pytest.mark.parametrize(
    ("x", "y", "zone"),
    [(20, 20, CONCRETE), (100, 20, GRAVEL), (90, 110, DRY_DIRT), (180, 120, WET_DIRT), (30, 130, SAND)],
)
def test_zones_lie_where_the_proposal_puts_them(x: float, y: float, zone: int) -> None:
    assert SMOOTH.zone(np.array([x]), np.array([y]))[0] == zone


def test_soils_have_the_papers_resistance() -> None:
    assert [s.c_rr for s in SOILS] == [0.008, 0.02, 0.04, 0.06, 0.25]


def test_slope_has_15_degrees_and_rises_6_m() -> None:
    x = np.linspace(SLOPE_FOOT_M + 2, SLOPE_TOP_M - 2, 50)
    east, north = SMOOTH.gradient(x, np.full(50, 60.0))
    np.testing.assert_allclose(np.degrees(np.arctan(east)), 15.0, atol=0.01)
    assert not north.any()
    np.testing.assert_allclose(SMOOTH.height(np.array([10.0, 190.0]), np.array([75.0, 75.0])), [0, 6], atol=1e-9)


def test_roughness_has_the_deviation_asked_for_and_follows_the_seed() -> None:
    rough = [paper_site.terrain(seed, 0.02).heights_m - SMOOTH.heights_m for seed in (3, 3, 4)]
    assert rough[0].std() == pytest.approx(0.02, rel=1e-6)
    assert np.array_equal(rough[0], rough[1])
    assert not np.array_equal(rough[0], rough[2])


@pytest.mark.parametrize("machine", range(12))
def test_route_is_drivable_and_stays_on_the_site(machine: int) -> None:
    route = paper_site.route_of(machine)
    assert 1 / np.abs(route.curvature()).max() > 8.0
    clearance = np.minimum(route.points, [WIDTH_M, DEPTH_M] - route.points).min()
    assert clearance > 8.0
    step = np.hypot(*np.diff(route.points, axis=0, append=route.points[:1]).T)
    np.testing.assert_allclose(step, route.spacing_m, rtol=0.02)


def test_routes_together_cover_all_zones_and_the_slope() -> None:
    points = np.vstack([paper_site.route_of(i).points for i in range(len(TOURS))])
    share = np.bincount(SMOOTH.zone(*points.T), minlength=5) / len(points)
    assert share.min() > 0.05, share
    on_slope = (points[:, 0] > SLOPE_FOOT_M) & (points[:, 0] < SLOPE_TOP_M)
    assert on_slope.mean() > 0.05


def test_routes_share_ground() -> None:
    for i, j in ((0, 1), (1, 2)):
        a, b = paper_site.route_of(i).points, paper_site.route_of(j).points
        apart = np.hypot(*(a[:, None] - b[None]).transpose(2, 0, 1)).min(axis=1)
        assert (apart < 0.5).sum() > 40, (i, j)


def test_later_machines_drive_the_other_way_from_elsewhere() -> None:
    first, second = paper_site.route_of(0), paper_site.route_of(len(TOURS))
    assert np.hypot(*(first.points[0] - second.points[0])) > 50
    ways = [np.sign(r.curvature().sum()) for r in (first, second)]
    assert ways[0] == -ways[1]


def test_drivers_slow_down_for_curves_in_time() -> None:
    route = rounded(((0, 0), (100, 0), (100, 100), (0, 100)), 5.0)
    limit = speed_limits(route, 6.0)
    assert limit.max() == 6.0
    assert limit.min() == pytest.approx(math.sqrt(0.9 / np.abs(route.curvature()).max()))
    braking = (limit**2 - np.roll(limit, -1) ** 2) / (2 * route.spacing_m)
    assert braking.max() <= 0.5 + 1e-9


def test_truth_map_holds_the_cells_centres() -> None:
    truth = truth_map(SMOOTH, WIDTH_M, DEPTH_M)
    assert truth.c_rr.shape == truth.grade_east.shape == (150, 200)
    assert truth.c_rr.dtype == truth.grade_north.dtype == np.float32
    assert truth.c_rr[20, 20] == np.float32(0.008)
    assert truth.c_rr[130, 30] == np.float32(0.25)
    assert truth.grade_east[75, 140] == pytest.approx(math.tan(math.radians(15)), abs=1e-6)
    assert abs(truth.grade_north).max() == 0
