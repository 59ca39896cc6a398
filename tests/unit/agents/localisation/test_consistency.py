import numpy as np
import pytest

from agents.localisation.consistency import (
    CANNOT_TELL,
    CONSISTENT,
    ENOUGH,
    INCONSISTENT,
    MAX_LEVEL,
    InnovationMonitor,
    VarianceFactor,
)
from agents.localisation.filters.belief import Belief, Conditioned
from agents.localisation.tuning import TUNING
from tests.unit.agents.drives import START_NS

BELIEF = Belief(1, np.zeros(2), np.eye(2))


def monitored(innovations: np.ndarray, std: float = 1.0, accepted: bool = True) -> InnovationMonitor:
    monitor = InnovationMonitor()
    for innovation in innovations:
        S = np.eye(2) * std**2
        monitor.note(Conditioned(BELIEF, innovation, S, float(innovation @ innovation) / std**2, accepted))
    return monitor


def white(seed: int = 3, n: int = 150) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((n, 2))


def test_white_innovations_of_the_right_size_are_good() -> None:
    consistency = monitored(white()).consistency()
    assert consistency.verdict == CANNOT_TELL
    assert consistency.nis == pytest.approx(1.0, abs=0.25)
    assert abs(consistency.correlation) < 0.25
    assert consistency.gated == 0.0


@pytest.mark.parametrize(
    ("monitor", "name"),
    [
        (monitored(white(), std=0.4), "nis"),  # filter overconfident
        (monitored(white(), std=4.0), "nis"),  # filter underconfident
        (monitored(np.repeat(white(n=15), 10, axis=0)), "correlation"),  # lasting error
        (monitored(white(), accepted=False), "gated"),
    ],
)
def test_what_a_consistent_filter_does_not_see_is_monitored(monitor: InnovationMonitor, name: str) -> None:
    consistency = monitor.consistency()
    good = monitored(white()).consistency()
    assert consistency.verdict == INCONSISTENT
    assert abs(getattr(consistency, name) - getattr(good, name)) > 0.4


def test_too_few_say_nothing_and_old_ones_are_forgotten() -> None:
    assert monitored(white(n=ENOUGH - 1)).consistency() is None
    monitor = monitored(10 * white())
    for innovation in white():
        monitor.note(Conditioned(BELIEF, innovation, np.eye(2), float(innovation @ innovation), accepted=True))
    assert monitor.consistency().verdict == CANNOT_TELL


def test_measurements_that_are_no_numbers_say_nothing_of_the_filter() -> None:
    monitor = InnovationMonitor()
    for _ in range(100):
        monitor.note(Conditioned(BELIEF, np.full(2, np.nan), np.eye(2), float("nan"), accepted=False))
    assert monitor.consistency() is None


def noted(slow_error: float, seconds: float) -> InnovationMonitor:
    """Consistent innovations at 5 Hz with a slow error of this mean square."""
    monitor = InnovationMonitor()
    for i, innovation in enumerate(white(n=round(5 * seconds))):
        belief = Belief(START_NS + i * 200_000_000, np.zeros(2), np.eye(2))
        result = Conditioned(belief, innovation, np.eye(2), float(innovation @ innovation), accepted=True)
        monitor.note(result, slow_error)
    return monitor


@pytest.mark.parametrize(
    ("slow_error", "is_checked", "verdict"),
    [
        (0.7, True, CONSISTENT),
        (0.7, False, CANNOT_TELL),
        (2 * MAX_LEVEL, True, INCONSISTENT),
        (2 * MAX_LEVEL, False, INCONSISTENT),
    ],
)
def test_a_slow_error_is_seen_by_its_size_and_denied_by_another_receiver_alone(
    slow_error: float, is_checked: bool, verdict: str
) -> None:
    consistency = noted(slow_error, 600.0).consistency(is_checked=is_checked)
    assert consistency.verdict == verdict
    assert consistency.slow_error == pytest.approx(slow_error, abs=0.35)


def test_a_slow_error_is_no_verdict_before_it_has_lasted() -> None:
    assert noted(2 * MAX_LEVEL, 30.0).consistency().verdict == CANNOT_TELL


def followed(std: float, seconds: float = 300.0, rate_hz: float = 5.0, accepted: bool = True) -> float:
    """The factor after innovations of `std` times the stated size."""
    draw, factor = np.random.default_rng(5), VarianceFactor()
    for i in range(round(seconds * rate_hz)):
        innovation, S = std * draw.standard_normal(2), factor.factor * np.eye(2)
        belief = Belief(START_NS + round(i / rate_hz * 1e9), np.zeros(2), np.eye(2))
        factor.note(Conditioned(belief, innovation, S, float(innovation @ innovation) / factor.factor, accepted))
    return factor.factor


@pytest.mark.parametrize("rate_hz", [1.0, 5.0])
@pytest.mark.parametrize("std", [0.5, 0.7, 1.0, 2.0, 3.0])
def test_the_variance_follows_the_innovations_within_five_minutes(std: float, rate_hz: float) -> None:
    assert followed(std, rate_hz=rate_hz) == pytest.approx(std**2, rel=0.35)


def test_the_variance_stays_within_its_bounds_and_follows_no_refused_innovation() -> None:
    assert followed(0.01, 3600) == TUNING.least_factor
    assert followed(100.0, 3600) == TUNING.most_factor
    assert followed(3.0, accepted=False) == 1.0
