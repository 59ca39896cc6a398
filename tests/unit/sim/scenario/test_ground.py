import math
from dataclasses import replace

import numpy as np
import pytest

from sim.scenario.file import load_scenario
from sim.scenario.ground import GroundConfig, RampConfig, ZoneConfig, build_terrain, with_zone
from sim.terrain.terrain import CONCRETE, DRY_DIRT, GRAVEL, SAND, SOILS, WET_DIRT, Terrain
from sim.truth import truth_map

PAPER = load_scenario("paper_site").ground
FOOT_M, TOP_M = PAPER.ramp[0].foot_m[0], PAPER.ramp[0].top_m[0]
SMOOTH = build_terrain(replace(PAPER, roughness_m=0.0), 0)


def test_gradient_is_the_slope_of_the_height() -> None:
    rng = np.random.default_rng(1)
    terrain = Terrain(rng.standard_normal((20, 30)), 0.5, np.zeros((1, 1), np.int64), 1.0)
    # avoids cell edges, where the bilinear surface has kinks
    x = (rng.integers(0, 28, 100) + rng.uniform(0.1, 0.9, 100)) * 0.5
    y = (rng.integers(0, 18, 100) + rng.uniform(0.1, 0.9, 100)) * 0.5
    east, north = terrain.gradient(x, y)
    h = 1e-4
    np.testing.assert_allclose(east, (terrain.height(x + h, y) - terrain.height(x - h, y)) / (2 * h), atol=1e-8)
    np.testing.assert_allclose(north, (terrain.height(x, y + h) - terrain.height(x, y - h)) / (2 * h), atol=1e-8)


def test_zones_lie_where_the_proposal_puts_them_and_resist_as_in_the_paper() -> None:
    x, y = np.array([[20, 20], [100, 20], [90, 110], [180, 120], [30, 130]]).T
    assert SMOOTH.zone(x, y).tolist() == [CONCRETE, GRAVEL, DRY_DIRT, WET_DIRT, SAND]
    assert [s.c_rr for s in SOILS] == [0.008, 0.02, 0.04, 0.06, 0.25]


def test_slope_has_15_degrees_and_rises_6_m() -> None:
    x = np.linspace(FOOT_M + 2, TOP_M - 2, 50)
    east, north = SMOOTH.gradient(x, np.full(50, 60.0))
    np.testing.assert_allclose(np.degrees(np.arctan(east)), 15.0, atol=0.01)
    assert not north.any()
    np.testing.assert_allclose(SMOOTH.height(np.array([10.0, 190.0]), np.array([75.0, 75.0])), [0, 6], atol=1e-9)


def test_foot_and_crown_of_a_ramp_are_rounded() -> None:
    x = np.arange(FOOT_M - 3, FOOT_M + 3, 0.25)
    east, _ = SMOOTH.gradient(x, np.full(x.shape, 60.0))
    bends = np.diff(east)
    assert bends.max() < 0.2 * math.tan(math.radians(15))  # no kink: at least five cells share the bend


def test_roughness_has_the_deviation_asked_for_and_follows_the_seed() -> None:
    rough = [build_terrain(replace(PAPER, roughness_m=0.02), seed).heights_m - SMOOTH.heights_m for seed in (3, 3, 4)]
    assert rough[0].std() == pytest.approx(0.02, rel=1e-6)
    assert np.array_equal(rough[0], rough[1])
    assert not np.array_equal(rough[0], rough[2])


def test_undulation_has_the_density_of_its_road_class_in_any_direction_whatever_the_seed() -> None:
    ground = GroundConfig(400, 400, "gravel", 0.5, 0.0, undulation_cm3=1024)
    waves = build_terrain(ground, 1).heights_m
    assert np.array_equal(waves, build_terrain(ground, 2).heights_m)
    for lines in (waves, waves.T):
        count = lines.shape[1]
        n = np.fft.rfftfreq(count, 0.5)
        density_m3 = (np.abs(np.fft.rfft(lines)) ** 2).mean(axis=0) * 2 * 0.5 / count
        middle = (n > 0.015) & (n < 0.06)  # beside the limits waves across the line are missing
        assert (density_m3 * (n / 0.1) ** 2)[middle].mean() == pytest.approx(1024e-6, rel=0.2)


def test_later_zones_cover_earlier_ones_and_paving_covers_all() -> None:
    square = ((2.0, 2.0), (8.0, 2.0), (8.0, 8.0), (2.0, 8.0))
    ground = GroundConfig(10, 10, "sand", 0.5, 0.0, (ZoneConfig("gravel", square), ZoneConfig("wet dirt", square)))
    before = build_terrain(ground, 0)
    after = with_zone(before, ZoneConfig("dry concrete", square))
    places = np.array([1.0, 5.0]), np.array([1.0, 5.0])
    assert before.zone(*places).tolist() == [SAND, WET_DIRT]
    assert after.zone(*places).tolist() == [SAND, CONCRETE]


@pytest.mark.parametrize(
    ("make", "problem"),
    [
        (lambda: ZoneConfig("sand", ((0, 0), (1, 0))), "outline: 2 corners"),
        (lambda: RampConfig((0, 0), (0, 0), 1.0), "foot_m, top_m"),
        (lambda: GroundConfig(5.0, 100, "sand"), "width_m: 5.0 is not between"),
        (lambda: GroundConfig(1e4, 1e4, "sand", 0.1), "cell_m: 0.1 m is too fine"),
        (lambda: GroundConfig(100, 100, "mud"), "soil: 'mud'"),
    ],
)
def test_impossible_ground_is_refused(make, problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        make()


def test_truth_map_holds_the_cells_centres() -> None:
    truth = truth_map(SMOOTH, PAPER.width_m, PAPER.depth_m)
    assert truth.c_rr.shape == truth.grade_east.shape == (150, 200)
    assert truth.c_rr.dtype == truth.grade_north.dtype == np.float32
    assert truth.c_rr[20, 20] == np.float32(0.008)
    assert truth.c_rr[130, 30] == np.float32(0.25)
    assert truth.grade_east[75, 140] == pytest.approx(math.tan(math.radians(15)), abs=1e-6)
    assert abs(truth.grade_north).max() == 0
