"""Coarse maps depend on no order, and remember only the newest periods."""

import numpy as np
import pytest

from mapserver.trust.coarse_map import LEVEL_FLOOR, PERIOD_S, PERIODS, CoarseMap, Surface, map_cell_m, pooled
from protocol.arrays import Table
from tests.unit.mapserver.data import NOW_NS, random_samples, samples

PERIOD_NS = round(PERIOD_S * 1e9)


def surface_of(parts: list[Table]) -> Surface:
    coarse = CoarseMap(1.0)
    for part in parts:
        coarse.add(part)
    return coarse.surface()


def same(one: Surface, other: Surface) -> bool:
    return (
        bool(np.array_equal(one.codes, other.codes) and np.array_equal(one.sums, other.sums))
        and one.std_m == other.std_m
    )


@pytest.mark.parametrize("seed", range(2))
def test_any_order_and_any_batching_give_the_same_bits(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rows = random_samples(20_000, seed)
    rows["stamp_ns"] += rng.integers(0, 2 * PERIODS, len(rows)) * PERIOD_NS
    mixed = np.array_split(rng.permutation(rows), np.sort(rng.integers(0, len(rows), 60)))
    assert same(surface_of([rows]), surface_of(mixed))


def test_a_cell_keeps_its_metres_and_its_mean_level() -> None:
    surface = surface_of([samples(2, c_rr=[0.02, 0.04], distance_m=[1.0, 3.0])])
    assert surface.metres.tolist() == [4.0]
    expected = (np.log(0.02 + LEVEL_FLOOR) + 3 * np.log(0.04 + LEVEL_FLOOR)) / 4
    assert surface.level == pytest.approx([expected], abs=1e-3)
    assert surface.std_m == pytest.approx(0.1, abs=0.01)


def test_rows_without_resistance_or_distance_are_not_entered() -> None:
    assert len(surface_of([samples(2, c_rr=[np.nan, 0.04], distance_m=[1.0, 0.0])]).codes) == 0


def test_only_the_newest_periods_are_remembered() -> None:
    numbers = np.array([PERIODS + 5, *range(PERIODS), 0])
    rows = samples(len(numbers), stamp_ns=NOW_NS + numbers * PERIOD_NS)
    assert len(surface_of([rows]).codes) == PERIODS
    assert same(surface_of([rows]), surface_of([rows[numbers > 0]]))


def test_a_pooled_map_without_one_of_its_parts_is_the_map_of_the_rest() -> None:
    one, other = surface_of([random_samples(500, 1)]), surface_of([random_samples(500, 2)])
    rest = pooled([one, other]).without(one)
    assert np.array_equal(rest.codes, other.codes)
    assert np.array_equal(rest.sums, other.sums)
    assert len(pooled([]).codes) == 0


@pytest.mark.parametrize(("cell_m", "expected"), [(1.0, 2.0), (0.5, 2.0), (0.7, 2.1), (5.0, 5.0)])
def test_cells_are_whole_cells_of_the_site(cell_m: float, expected: float) -> None:
    assert map_cell_m(cell_m) == pytest.approx(expected)
