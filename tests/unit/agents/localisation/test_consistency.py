import numpy as np
import pytest

from agents.localisation.consistency import ENOUGH, Watch
from agents.localisation.filters.belief import Belief, Conditioned

BELIEF = Belief(1, np.zeros(2), np.eye(2))


def told(innovations: np.ndarray, std: float = 1.0, accepted: bool = True) -> Watch:
    watch = Watch()
    for innovation in innovations:
        S = np.eye(2) * std**2
        watch.note(Conditioned(BELIEF, innovation, S, float(innovation @ innovation) / std**2, accepted))
    return watch


def white(seed: int = 3, n: int = 150) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((n, 2))


def test_white_innovations_of_the_right_size_are_good() -> None:
    found = told(white()).consistency()
    assert found is not None
    assert found.is_good
    assert found.nis == pytest.approx(1.0, abs=0.25)
    assert abs(found.alike) < 0.25
    assert found.gated == 0.0


@pytest.mark.parametrize(
    ("watch", "name"),
    [
        (told(white(), std=0.4), "nis"),  # the filter thinks itself better than it is
        (told(white(), std=4.0), "nis"),  # and worse
        (told(np.repeat(white(n=15), 10, axis=0)), "alike"),  # an error that stays
        (told(white(), accepted=False), "gated"),
    ],
)
def test_what_a_consistent_filter_does_not_see_is_told(watch: Watch, name: str) -> None:
    found = watch.consistency()
    good = told(white()).consistency()
    assert found is not None
    assert good is not None
    assert not found.is_good
    assert abs(getattr(found, name) - getattr(good, name)) > 0.4


def test_too_few_say_nothing_and_old_ones_are_forgotten() -> None:
    assert told(white(n=ENOUGH - 1)).consistency() is None
    watch = told(10 * white())
    for innovation in white():
        watch.note(Conditioned(BELIEF, innovation, np.eye(2), float(innovation @ innovation), accepted=True))
    found = watch.consistency()
    assert found is not None
    assert found.is_good


def test_measurements_that_are_no_numbers_say_nothing_of_the_filter() -> None:
    watch = Watch()
    for _ in range(100):
        watch.note(Conditioned(BELIEF, np.full(2, np.nan), np.eye(2), float("nan"), accepted=False))
    assert watch.consistency() is None
