import numpy as np
import pytest

from agents.localisation.consistency import ENOUGH, InnovationMonitor
from agents.localisation.filters.belief import Belief, Conditioned

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
    assert consistency is not None
    assert consistency.is_good
    assert consistency.nis == pytest.approx(1.0, abs=0.25)
    assert abs(consistency.correlation) < 0.25
    assert consistency.gated == 0.0


@pytest.mark.parametrize(
    ("monitor", "name"),
    [
        (monitored(white(), std=0.4), "nis"),  # the filter thinks itself better than it is
        (monitored(white(), std=4.0), "nis"),  # and worse
        (monitored(np.repeat(white(n=15), 10, axis=0)), "correlation"),  # an error that stays
        (monitored(white(), accepted=False), "gated"),
    ],
)
def test_what_a_consistent_filter_does_not_see_is_monitored(monitor: InnovationMonitor, name: str) -> None:
    consistency = monitor.consistency()
    good = monitored(white()).consistency()
    assert consistency is not None
    assert good is not None
    assert not consistency.is_good
    assert abs(getattr(consistency, name) - getattr(good, name)) > 0.4


def test_too_few_say_nothing_and_old_ones_are_forgotten() -> None:
    assert monitored(white(n=ENOUGH - 1)).consistency() is None
    monitor = monitored(10 * white())
    for innovation in white():
        monitor.note(Conditioned(BELIEF, innovation, np.eye(2), float(innovation @ innovation), accepted=True))
    consistency = monitor.consistency()
    assert consistency is not None
    assert consistency.is_good


def test_measurements_that_are_no_numbers_say_nothing_of_the_filter() -> None:
    monitor = InnovationMonitor()
    for _ in range(100):
        monitor.note(Conditioned(BELIEF, np.full(2, np.nan), np.eye(2), float("nan"), accepted=False))
    assert monitor.consistency() is None
