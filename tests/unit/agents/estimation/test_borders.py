"""The search for borders against all histories that there are, and what it remembers."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from agents.estimation import borders
from agents.estimation.balance import BalanceStep
from agents.estimation.borders import COLOURED, FIRST_C_RR, FIRST_STD, JUMP_STD, MOST, UNEVEN, BorderSearch
from protocol.arrays import Floats
from tests.unit.agents.ground import STEP_S, level_steps, white_noise

NOISE = 0.004
R = NOISE**2 / STEP_S
STEP_M = 0.1


def borders_after(steps: Sequence[BalanceStep], remembered: int = 200) -> list[tuple[int, ...]]:
    """The borders after each step, by its index."""
    search = BorderSearch(remembered)
    return [search.update(index, step, step.raw, R) for index, step in enumerate(steps)]


def evidence(raw: Floats, history: Sequence[int]) -> float:
    """How likely raw values (n,) of one axle are, in logarithms, with borders before these: Gaussians, part by part."""
    total, mean, first_var = 0.0, FIRST_C_RR, FIRST_STD**2
    for begin, end in itertools.pairwise([0, *history, len(raw)]):
        part, walked = raw[begin:end], np.arange(1, end - begin + 1) * UNEVEN**2 * STEP_M
        prior = first_var + np.minimum(walked[:, None], walked)
        covariance = prior + COLOURED * R * np.eye(len(part))
        off = part - mean
        solved = np.linalg.solve(covariance, off)
        total -= 0.5 * (off @ solved + np.linalg.slogdet(covariance)[1])
        mean, first_var = mean + float(prior[-1] @ solved), JUMP_STD**2
    return total + len(history) * math.log(math.expm1(borders.BORDERS_PER_M * STEP_M))


@pytest.mark.parametrize("seed", range(2))
def test_no_history_is_likelier_than_the_one_that_is_found(monkeypatch: pytest.MonkeyPatch, seed: int) -> None:
    """All with two borders at most. A border is known by what is behind it, so the last steps have none."""
    monkeypatch.setattr(borders, "LIKELY", 1e12)
    rng = np.random.default_rng(seed)
    levels = rng.choice([0.02, 0.06, 0.1, 0.25], 3, replace=False)
    raw = levels[np.minimum(np.arange(30) // 10, 2)] + white_noise(NOISE, 30, rng)
    histories = [h for count in range(3) for h in itertools.combinations(range(1, 30), count)]
    likeliest = max(histories, key=lambda history: evidence(raw, history))
    assert borders_after(level_steps(raw))[-1] == likeliest


def test_one_ground_has_no_border_and_a_jolt_is_none() -> None:
    raw = 0.05 + white_noise(NOISE, 400, np.random.default_rng(1))
    raw[200:203] += 0.3
    assert borders_after(level_steps(raw))[-1] == ()


def test_histories_are_few_and_forget_what_nobody_asks_for() -> None:
    raw = np.where(np.arange(2000) // 100 % 2, 0.02, 0.12) + white_noise(NOISE, 2000, np.random.default_rng(3))
    search = BorderSearch(300)
    for index, step in enumerate(level_steps(raw)):
        history = search.update(index, step, step.raw, R)
        assert len(search._borders) == search._rows.shape[1] <= MOST
    assert len(history) in (3, 4)
    assert all(border > 1500 for border in history)


def test_after_a_long_way_of_which_nothing_is_known_another_ground_is_no_surprise() -> None:
    """Digging for a minute: a difference that is too small for a border on 0.1 m is one after 60 m."""
    raw = 0.03 + 0.02 * (np.arange(60) >= 40)
    near = level_steps(raw)
    far = [replace(step, distance_m=60.0) if index == 40 else step for index, step in enumerate(near)]
    assert borders_after(near)[-1] == ()
    assert borders_after(far)[-1] == (40,)
    endless = [replace(step, distance_m=1e6) if index == 40 else step for index, step in enumerate(near)]
    assert borders_after(endless)[-1] == (40,)
