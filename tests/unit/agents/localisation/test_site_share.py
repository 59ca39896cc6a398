"""The share that machine and base have in common is found from both alone, and lost where a base goes wrong."""

from __future__ import annotations

import numpy as np
import pytest

from agents.localisation.filters.motion import GpsError
from agents.localisation.site_share import WAIT_S, SiteShareEstimator
from protocol.machine.readings import Correction

T0 = 1_750_000_000_000_000_000
ERROR = GpsError(2.7, 45.0)
WHITE_M2 = 0.06  # mean of a second


def slow(rng: np.random.Generator, seconds: int, time_s: float = ERROR.time_s) -> np.ndarray:
    """A Gauss-Markov error (n, 2) of variance 1, once a second."""
    keep = np.exp(-1 / time_s)
    white = rng.standard_normal((seconds, 2))
    out = np.empty_like(white)
    out[0] = white[0]
    for i in range(1, seconds):
        out[i] = keep * out[i - 1] + np.sqrt(1 - keep**2) * white[i]
    return out


def errors(share: float, seconds: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Slow errors of machine and base (n, 2) [m]."""
    rng = np.random.default_rng(seed)
    site, machine, base = (slow(rng, seconds) for _ in range(3))
    common, std = np.sqrt(share) * site, np.sqrt(ERROR.variance_m2)
    return std * (common + np.sqrt(1 - share) * machine), std * (common + np.sqrt(1 - share) * base)


def follow(
    estimator: SiteShareEstimator, machine: np.ndarray, base: np.ndarray, seed: int, start: int = 0, late_s: int = 0
) -> None:
    """Let a machine drive round at 4 m/s beside a base; once a second. late_s: how long corrections are held up.

    Its dead reckoning walks by 0.03 m per sqrt(m), and has scale and heading wrong by 0.015, which changes in a minute.
    """
    rng = np.random.default_rng([seed, start, 1])
    late: list[Correction] = []
    heading = np.cumsum(rng.uniform(-0.1, 0.15, len(machine)))
    shifts = 4.0 * np.exp(1j * heading)
    wrong = 0.015 * slow(rng, len(machine), 60.0).view(complex)[:, 0] * shifts
    lost = np.cumsum(wrong + rng.standard_normal((len(machine), 2)).view(complex)[:, 0] * 0.06).view(float)
    for i, (e, b) in enumerate(zip(machine + lost.reshape(-1, 2), base, strict=True)):
        white = rng.standard_normal((2, 2)) * np.sqrt(WHITE_M2)
        stamp_ns = T0 + (start + i) * 10**9
        estimator.drive(stamp_ns, np.array([shifts[i].real, shifts[i].imag]))
        estimator.add_fix("gps-1", stamp_ns, e + white[0], WHITE_M2, ERROR)
        east_m, north_m = (b + white[1]).tolist()
        slow_m2, time_s = ERROR.variance_m2, ERROR.time_s
        late.append(Correction("base-1", stamp_ns, east_m, north_m, WHITE_M2, slow_m2, time_s, 0.0, 0.0, 1.0))
        if i >= late_s:
            estimator.add_correction(late.pop(0))


@pytest.mark.parametrize(
    ("share", "off"),
    [(0.0, 0.1), (0.8, 0.1), pytest.param(0.95, 0.05, marks=pytest.mark.nightly)],
)
@pytest.mark.slow
def test_share_is_found_in_ten_minutes_and_not_overstated(share: float, off: float) -> None:
    shares = []
    for seed in range(3):
        estimator = SiteShareEstimator()
        follow(estimator, *errors(share, 600, seed), seed)
        shares.append(estimator.share)
    assert np.mean(shares) == pytest.approx(share, abs=off), shares


@pytest.mark.slow
def test_link_that_holds_corrections_up_costs_nothing_of_the_share() -> None:
    machine, base = errors(0.9, 200, 4)
    late, at_once = SiteShareEstimator(), SiteShareEstimator()
    follow(at_once, machine, base, 4)
    follow(late, machine, base, 4, late_s=WAIT_S - 1)
    assert late.share == pytest.approx(at_once.share, abs=1e-9)


@pytest.mark.slow
def test_base_that_repeats_what_is_long_past_loses_its_share_within_a_minute() -> None:
    machine, base = errors(0.95, 1000, 5)
    estimator = SiteShareEstimator()
    follow(estimator, machine[:900], base[:900], 5)
    before = estimator.share
    follow(estimator, machine[900:960], base[:60], 5, start=900)
    assert before > 0.9
    assert estimator.share < 0.3


@pytest.mark.slow
def test_outliers_of_fixes_and_a_machine_that_was_carried_say_nothing_of_the_share() -> None:
    machine, base = errors(0.95, 420, 5)
    true, seconds = SiteShareEstimator(), np.arange(420)
    follow(true, machine, base, 5)
    once, often, carried = seconds == 400, seconds % 60 == 40, seconds >= 400
    for wrong, off_m in ((once, 80.0), (often, 5.0), (carried, 10.0)):
        estimator = SiteShareEstimator()
        follow(estimator, machine + [off_m, 0.0] * wrong[:, None], base, 5)
        assert estimator.share == pytest.approx(true.share, abs=0.05)


def test_another_receiver_speaks_only_when_the_first_is_silent() -> None:
    estimator = SiteShareEstimator()
    for i in range(60):
        estimator.add_fix("gps-1", T0 + i * 10**9, np.zeros(2), WHITE_M2, ERROR)
        estimator.add_fix("gps-2", T0 + i * 10**9, np.full(2, 1e6), WHITE_M2, ERROR)
    assert np.isfinite(estimator.share)
    assert np.abs(estimator._x).max() < 10
    for i in range(80, 110):
        estimator.add_fix("gps-2", T0 + i * 10**9, np.full(2, 30.0), WHITE_M2, ERROR)
    assert estimator._x[0, 0] == pytest.approx(30.0, abs=8.0)
