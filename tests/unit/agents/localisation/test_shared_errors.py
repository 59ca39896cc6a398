"""Shared receiver errors, estimated from synthetic fixes on circles."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import pytest

from agents.localisation.shared_errors import SPAN_NS, SharedFix, ShareEstimator
from protocol.arrays import Floats

SLOW_M2, TIME_S, WHITE_M2, RATE_HZ = 2.7, 45.0, 0.3, 5
LEVERS_M = np.array([[0.8, 0.0], [0.3, 0.6], [-1.5, -0.6]])
ROTATION_RAD = 0.8  # of dead reckoning in `map`
SEED = 11


def slow_errors(seed: int, seconds: float, receivers: int, share: float, slow_m2: float = SLOW_M2) -> Floats:
    """Errors (n, receivers, 2) [m] with this common share."""
    rng, n = np.random.default_rng(seed), round(seconds * RATE_HZ)
    keep = np.exp(-1 / RATE_HZ / TIME_S)
    parts = rng.standard_normal((n, receivers + 1, 2))
    parts[1:] *= np.sqrt(1 - keep**2)
    for before, now in pairwise(parts):
        now += keep * before
    return np.sqrt(slow_m2) * (np.sqrt(share) * parts[:, :1] + np.sqrt(1 - share) * parts[:, 1:])


def fixes_of(errors_m: Floats, seed: int = SEED) -> list[SharedFix]:
    """Fixes on circles at 2 m/s, each receiver at its own instants."""
    rng, made = np.random.default_rng(seed + 10_000), []
    white = np.sqrt(WHITE_M2) * rng.standard_normal(errors_m.shape)
    c, s = np.cos(ROTATION_RAD), np.sin(ROTATION_RAD)
    for i, j in np.ndindex(errors_m.shape[:2]):
        t = (i + 0.3 * j) / RATE_HZ
        heading = 0.2 * t
        lever = LEVERS_M[j, 0] + 1j * LEVERS_M[j, 1]
        reckoned = 500 + 10 * np.sin(heading) - 10j * np.cos(heading) + lever * np.exp(1j * heading)
        place = np.array([[c, -s], [s, c]]) @ [reckoned.real, reckoned.imag] + [70.0, -30.0]
        stamp = round(t * 1e9) + 5 * SPAN_NS
        place += errors_m[i, j] + white[i, j]
        made.append(SharedFix(j, stamp, place, (reckoned.real, reckoned.imag), WHITE_M2, SLOW_M2, TIME_S))
    return made


def estimate(fixes: Sequence[SharedFix], receivers: int) -> ShareEstimator:
    estimator = ShareEstimator(receivers)
    for fix in fixes:
        estimator.add(fix, ROTATION_RAD)
    return estimator


@pytest.mark.slow
@pytest.mark.parametrize("receivers", [2, pytest.param(3, marks=pytest.mark.nightly)])
def test_over_all_shares_the_mean_is_right_and_better_with_time(receivers: int) -> None:
    """With shares drawn from the prior, the mean residual is zero: a law of every posterior."""
    true = np.concatenate([np.zeros(10), (np.arange(10) + 0.5) / 10])
    early, late = [], []
    for seed, share in enumerate(true):
        estimator = ShareEstimator(receivers)
        for fix in fixes_of(slow_errors(seed, 240, receivers, share), seed):
            estimator.add(fix, ROTATION_RAD)
            if fix.stamp_ns == 30 * SPAN_NS:
                first = estimator.share
        early.append(first)
        late.append(estimator.share)
    for shares, least_correlation in ((early, 0.4), (late, 0.7)):
        off = np.array(shares) - true
        assert abs(off.mean()) < 4 * off.std() / np.sqrt(len(true))
        assert np.corrcoef(shares, true)[0, 1] > least_correlation
    assert np.abs(np.array(late) - true).mean() < np.abs(np.array(early) - true).mean() < 0.25


def test_outliers_say_nothing() -> None:
    """A receiver far off for a second in eight or half a minute; single fixes refused by the filter."""
    errors = slow_errors(SEED, 180, 2, 0.95)
    plain = estimate(fixes_of(errors), 2).share
    wild = errors.copy()
    wild.reshape(-1, RATE_HZ, 2, 2)[::8, :, 1] += 30.0
    assert estimate(fixes_of(wild), 2).share == pytest.approx(plain, abs=0.1)
    wild = errors.copy()
    wild[300:450, 0] += 40.0
    assert estimate(fixes_of(wild), 2).share == pytest.approx(plain, abs=0.15)


def test_receivers_that_err_less_than_they_state_share_it_for_all_one_knows() -> None:
    """The safe side: several then count as one."""
    errors = slow_errors(SEED, 120, 2, 0.0, slow_m2=0.1 * SLOW_M2)
    assert estimate(fixes_of(errors), 2).share > 0.7
    wider = slow_errors(SEED, 180, 2, 0.0, slow_m2=4 * SLOW_M2)
    assert estimate(fixes_of(wider), 2).share < 0.2
