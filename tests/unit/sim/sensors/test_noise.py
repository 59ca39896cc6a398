import math

import numpy as np
import pytest

from sim.sensors.noise import BLOCK_ROWS, STREAMS, Draws, GaussMarkov, generator, site_generator
from tests.unit.sim.sensor_rigs import check_correlation, check_deviation

SEED = 7
UNITS = 2000


def walk(sigma: float, time_s: float, dt: float, rows: int) -> np.ndarray:
    rng = np.random.default_rng(SEED)
    start = rng.standard_normal((1, UNITS))
    process = GaussMarkov(np.full((1, UNITS), sigma), np.full(UNITS, time_s), dt, start)
    return process.run(rng.standard_normal((1, rows, UNITS)))[0]


@pytest.mark.parametrize("rate_hz", [5, 20])
def test_gauss_markov_has_its_deviation_and_correlation_time_at_any_rate(rate_hz: int) -> None:
    errors = walk(2.0, 1.5, 1 / rate_hz, 6 * rate_hz)
    check_deviation(errors, 2.0, UNITS)
    check_correlation(errors, round(1.5 * rate_hz), math.exp(-round(1.5 * rate_hz) / (1.5 * rate_hz)), UNITS)


def test_gauss_markov_has_a_deviation_and_a_time_of_each_unit() -> None:
    rng = np.random.default_rng(SEED)
    sigma, time_s = np.array([[1.0, 5.0]]), np.array([0.1, 10.0])
    errors = GaussMarkov(sigma, time_s, 0.1, np.zeros((1, 2))).run(rng.standard_normal((1, 200_000, 2)))[0]
    for unit, lag in ((0, 1), (1, 100)):
        check_deviation(errors[:, unit], sigma[0, unit], round(20_000 / 2 / time_s[unit]))
        check_correlation(errors[:, unit], lag, math.exp(-1), round(20_000 / 2 / time_s[unit]))


def test_gauss_markov_does_not_depend_on_the_length_of_runs() -> None:
    rng = np.random.default_rng(SEED)
    white, start, times = rng.standard_normal((3, 50, 4)), rng.standard_normal((3, 4)), np.arange(1.0, 5.0)
    whole, parts = (GaussMarkov(np.ones((3, 4)), times, 0.1, start) for _ in range(2))
    expected = whole.run(white)
    np.testing.assert_array_equal(np.concatenate([parts.run(p) for p in np.split(white, 10, axis=1)], axis=1), expected)


def test_draws_are_each_sensors_own_row_by_row() -> None:
    rows = 2 * BLOCK_ROWS + 17
    draws = Draws([np.random.default_rng(s) for s in (1, 2)], 3)
    taken = np.concatenate([draws.next_rows(n) for n in (1, BLOCK_ROWS + 5, rows - BLOCK_ROWS - 6)], axis=1)
    for unit, seed in enumerate((1, 2)):
        alone = np.random.default_rng(seed).standard_normal((rows, 3))
        np.testing.assert_array_equal(taken[:, :, unit], alone.T)


def test_generators_differ_between_seeds_machines_and_sensors() -> None:
    draws = [generator(s, m, name).random() for s in range(2) for m in range(3) for name in STREAMS]
    draws += [site_generator(s).random() for s in range(2)]
    assert len(set(draws)) == len(draws)
