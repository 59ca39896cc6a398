"""The filter against least squares and the joint Gaussian; borders, memory, mass."""

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from agents.estimation.balance import BalanceStep
from agents.estimation.borders import MOST, BorderSearch
from agents.estimation.resistance_kalman import KEPT, KalmanResistance
from agents.estimation.tuning import TUNING, EstimationTuning
from protocol.arrays import Floats
from tests.unit.agents.drives import START_NS
from tests.unit.agents.ground import STEP_S, feed, level_steps, white_noise

QUIET = 0.002  # half the least assumed noise: no more is measured
NO_BORDERS = replace(TUNING, borders_per_m=1e-300)
STILL = replace(NO_BORDERS, walk=1e-9)  # constant ground
STEP_NS = round(STEP_S * 1e9)


def fed(raw: Iterable[float], tuning: EstimationTuning = TUNING) -> KalmanResistance:
    kalman = KalmanResistance(tuning=tuning)
    feed(kalman, level_steps(raw))
    return kalman


def at_step(kalman: KalmanResistance, index: int) -> tuple[float, float]:
    return kalman.at(START_NS + index * STEP_NS)


def borders(kalman: KalmanResistance) -> list[int]:
    """Steps since the start that begin a new ground."""
    return [round((s.measured.step.stamp_ns - START_NS) / STEP_NS) for s in kalman._steps if s.border]


def nearest_border(kalman: KalmanResistance, index: int) -> int:
    """Distance of the nearest one, in steps."""
    return min((abs(i - index) for i in borders(kalman)), default=99)


def scale_of(kalman: KalmanResistance) -> tuple[float, float]:
    """Scale error, variance."""
    newest = kalman._steps[-1]
    return float(newest.x[2]), float(newest.P[2, 2])


@pytest.mark.parametrize(("border", "wheelbase_m"), [(12, 0.0), (None, 0.5), (12, 0.5)])
def test_smoother_is_the_joint_gaussian(border: int | None, wheelbase_m: float) -> None:
    """Joint estimate: c_rr walks and jumps at a border; each step sees the ground of both axles."""
    seed, n = 2, 30
    rng = np.random.default_rng(seed)
    tuning = replace(NO_BORDERS, walk=0.02, unknown_std=0.08)
    kalman = KalmanResistance(tuning=tuning)
    raw = 0.05 + np.cumsum(0.003 * rng.standard_normal(n)) + white_noise(QUIET, n, rng)
    feed(kalman, [replace(s, lead_share=0.6, wheelbase_m=wheelbase_m, lead_m=0.2) for s in level_steps(raw)])
    if border:
        kalman._set_borders({border + 1})
    x, P = joint(raw, border, tuning, wheelbase_m)
    for index in range(n):
        centre = index
        if border and wheelbase_m and 0 <= index - border < 2:  # within 0.2 m of it the load centre is still behind
            centre = border - 1
        assert at_step(kalman, index) == pytest.approx((x[centre], P[centre, centre]), rel=1e-3), f"{seed=} {index=}"


def joint(raw: Floats, border: int | None, tuning: EstimationTuning, wheelbase_m: float = 0.0) -> tuple[Floats, Floats]:
    """Posterior mean (n,) and covariance (n, n) of c_rr under the leading axle."""
    n = len(raw)
    walk = tuning.walk**2 * 2.0 * STEP_S
    mean, variance = np.full(n, tuning.first_c_rr), tuning.unknown_std**2 + walk * np.arange(1, n + 1)
    new = np.zeros(n, bool)
    if border is not None:  # of earlier knowledge only the value remains
        new[border:] = True
        mean[border:] = joint(raw[:border], None, tuning)[0][-1]
        variance[border:] = tuning.unknown_std**2 + walk * np.arange(1, n - border + 1)
    prior = np.where(new[:, None] == new, np.minimum(variance[:, None], variance), 0.0)
    H = np.eye(n)
    if border is not None and wheelbase_m:
        for i in range(border, border + round(wheelbase_m / 0.1)):  # until the trailing axle arrives
            H[i, i], H[i, border - 1] = 0.6, 0.4
    gain = prior @ H.T @ np.linalg.inv(H @ prior @ H.T + tuning.noise**2 / STEP_S * np.eye(n))
    return mean + gain @ (raw - H @ mean), prior - gain @ H @ prior


# --- borders ---------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_border_is_dated_to_where_it_began() -> None:
    before, step, is_dated = 100, -0.02, []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        raw = 0.05 + np.where(np.arange(before + 50) < before, 0.0, step) + white_noise(0.002, before + 50, rng)
        kalman = fed(raw, replace(TUNING, noise=0.002))
        is_dated.append(nearest_border(kalman, before) <= 2)
        assert len(borders(kalman)) == 1, f"{seed=}"
    assert sum(is_dated) >= 5


@pytest.mark.slow
def test_a_border_is_taken_back_where_it_was_a_bump() -> None:
    """A second of one-sided noise resembles a border until the old value returns."""
    raw = 0.04 + 0.03 * ((np.arange(200) >= 100) & (np.arange(200) < 120))
    kalman, seen = KalmanResistance(), []
    for step in level_steps(raw):
        kalman.update(step)
        seen.append(len(borders(kalman)))
    assert max(seen) > 0
    assert seen[-1] == 0
    assert at_step(kalman, 180)[0] == pytest.approx(0.04, abs=2e-3)


# --- two axles -------------------------------------------------------------------------------------------------------

AXLES = {"wheelbase_m": 3.3, "lead_m": 1.8, "lead_share": 0.45}


def crossing(before: float, behind: float, at_m: float, metres: float = 20.0) -> list[BalanceStep]:
    """A front axle from way 0 over a border, noise-free."""
    steps: list[BalanceStep] = []
    for step in level_steps(np.zeros(round(metres / 0.1))):
        lead_m = 0.1 * (len(steps) + 1)
        lead, trail = (behind if m > at_m else before for m in (lead_m, lead_m - 3.3))
        steps.append(replace(step, raw=0.45 * lead + 0.55 * trail, **AXLES))  # type: ignore[arg-type]
    return steps


@pytest.mark.parametrize(("before", "behind"), [(0.09, 0.04), (0.01, 0.25)])
def test_border_that_two_axles_cross_is_one(before: float, behind: float) -> None:
    kalman = KalmanResistance()
    feed(kalman, crossing(before, behind, 10.0))
    assert nearest_border(kalman, 100) <= 2
    for index in range(200):  # the load centre is 1.8 m behind the front axle
        if abs(index - 118) > 4 and index >= 100:
            assert at_step(kalman, index)[0] == pytest.approx(
                before if index < 118 else behind, abs=max(5e-3, 0.1 * behind)
            )


def test_back_across_a_border_half_crossed() -> None:
    """The front axle 1 m onto new ground, then back: the old ground is found again."""
    kalman = KalmanResistance()
    there = crossing(0.03, 0.12, 9.0, 10.0)
    feed(kalman, there)
    home = []
    for i, step in enumerate(level_steps(np.zeros(60))):
        front_m = 10.0 - 0.1 * (i + 1)
        raw = -(0.45 * (0.12 if front_m > 9.0 else 0.03) + 0.55 * 0.03)
        lead = {**AXLES, "lead_m": 1.5, "lead_share": 0.55}
        step = replace(step, stamp_ns=there[-1].stamp_ns + (i + 20) * STEP_NS, raw=raw, regressor=-1.0, **lead)
        home.append(step)
    feed(kalman, home)
    assert kalman.at(home[-1].stamp_ns)[0] == pytest.approx(0.03, abs=0.01)


def test_memory_is_bounded_and_answers_stay_right() -> None:
    rng = np.random.default_rng(8)
    raw = 0.05 + white_noise(QUIET, 3000, rng)
    kalman, recent = KalmanResistance(tuning=STILL), KalmanResistance(tuning=STILL)
    steps = level_steps(raw)
    feed(kalman, steps)
    assert len(kalman._steps) <= 2 * KEPT
    assert at_step(kalman, 2999)[0] == pytest.approx(raw.mean(), abs=1e-6)
    assert at_step(kalman, 2999)[1] == pytest.approx(0.004**2 / (3000 * STEP_S), rel=1e-3)
    assert at_step(kalman, 2910)[0] == pytest.approx(raw.mean(), abs=1e-6)
    assert kalman.at(START_NS) is None
    feed(recent, steps[:1])
    assert recent.at(START_NS)


# --- the mass --------------------------------------------------------------------------------------------------------


def at_work(scale: float, seconds: float, seed: int, c_rr: float = 0.05, start: int = 0) -> list[BalanceStep]:
    """A loader accelerating and climbing, with a scale error of drive force over assumed mass."""
    rng = np.random.default_rng(seed)
    n = round(seconds / STEP_S)
    taken = 0.08 * np.sin(0.05 * np.arange(n)) + 0.04 * np.sin(0.013 * np.arange(n))
    share = (1 + scale) * (c_rr + taken)  # measured
    steps = level_steps(share - taken + white_noise(0.004, n, rng), share=share)
    return [replace(s, stamp_ns=s.stamp_ns + start * STEP_NS) for s in steps]


@pytest.mark.slow
def test_wrong_mass_is_found_where_forces_vary() -> None:
    """raw = c_rr + scale error / (1 + ...) * share: drive force beyond the motion's."""
    kalman, blind = (KalmanResistance(estimates_mass=m) for m in (True, False))
    scale = -0.2
    steps = at_work(scale, 90, 1)
    feed(kalman, steps)
    feed(blind, steps)
    assert scale_of(kalman)[0] == pytest.approx(scale / (1 + scale), abs=0.02)
    first = len(steps) - 90
    errors, blinds = ([abs(at_step(e, i)[0] - 0.05) for i in range(first, len(steps))] for e in (kalman, blind))
    assert np.mean(errors) < 4e-3
    assert np.mean(blinds) > 1.3 * np.mean(errors)


@pytest.mark.slow
def test_load_that_changes_at_a_stop_is_found_again() -> None:
    kalman = KalmanResistance(estimates_mass=True)
    feed(kalman, at_work(0.0, 120, 1))
    before = scale_of(kalman)
    assert before[0] == pytest.approx(0.0, abs=0.02)
    kalman.stand(changes_load=True)
    feed(kalman, at_work(0.25, 1, 2, start=4200))
    assert max(s.P[2, 2] for s in kalman._steps[-20:]) > 20 * before[1]
    feed(kalman, at_work(0.25, 60, 3, start=4300))
    assert scale_of(kalman)[0] == pytest.approx(0.2, abs=0.03)


@pytest.mark.parametrize("steps", [30, 230])
def test_recalibrated_is_as_if_all_steps_had_had_the_new_calibration(steps: int) -> None:
    rng = np.random.default_rng(3)
    raw = np.where(np.arange(300) < steps - 20, 0.04, 0.1) + white_noise(TUNING.noise, 300, rng)
    changed = fed(raw[:steps])
    before = borders(changed)
    assert before
    changed.recalibrate(0.005, 0.1)
    assert borders(changed) == before
    new = raw - 0.005 - 0.1 * 0.04
    feed(changed, level_steps(new)[steps:])
    always = fed(new)
    assert borders(changed) == borders(always)
    for index in range(max(250 - KEPT, 20), 300, 7):
        assert at_step(changed, index) == pytest.approx(at_step(always, index), abs=3e-5)


@pytest.mark.slow
def test_a_change_of_the_calibration_soon_after_a_turn_is_no_border() -> None:
    """A zero counts oppositely ahead and in reverse, so it is not a common shift."""
    rng = np.random.default_rng(11)
    reverse, zero = 20, 0.01
    n = 300 + reverse + 100
    direction = np.where(np.arange(n) < 300, 1.0, -1.0)
    raw = direction * 0.04 + zero + white_noise(TUNING.noise, n, rng)
    steps = [replace(s, regressor=d, raw=r) for s, d, r in zip(level_steps(raw), direction, raw, strict=True)]
    kalman = KalmanResistance()
    feed(kalman, steps[: 300 + reverse])
    kalman.recalibrate(zero, 0.0)
    feed(kalman, [replace(s, raw=s.raw - zero) for s in steps[300 + reverse :]])
    assert not [border for border in borders(kalman) if border >= 300 + reverse]
    assert at_step(kalman, n - 1)[0] == pytest.approx(0.04, abs=4e-3)


# --- border search against all histories -----------------------------------------------------------------------------

WHITE = 0.004
R = WHITE**2 / STEP_S
STEP_M = 0.1


def borders_after(
    steps: Sequence[BalanceStep], remembered: int = 200, tuning: EstimationTuning = TUNING
) -> list[tuple[int, ...]]:
    """Indices of the borders after each step."""
    search = BorderSearch(remembered, tuning)
    return [search.update(index, step, step.raw, R) for index, step in enumerate(steps)]


def evidence(raw: Floats, history: Sequence[int]) -> float:
    """Log likelihood of one axle's raw values (n,) with these borders: Gaussian by part."""
    total, mean, first_var = 0.0, TUNING.first_c_rr, TUNING.unknown_std**2
    for begin, end in itertools.pairwise([0, *history, len(raw)]):
        part, walked = raw[begin:end], np.arange(1, end - begin + 1) * TUNING.uneven**2 * STEP_M
        prior = first_var + np.minimum(walked[:, None], walked)
        covariance = prior + TUNING.coloured * R * np.eye(len(part))
        off = part - mean
        solved = np.linalg.solve(covariance, off)
        total -= 0.5 * (off @ solved + np.linalg.slogdet(covariance)[1])
        mean, first_var = mean + float(prior[-1] @ solved), TUNING.unknown_std**2
    return total + len(history) * math.log(math.expm1(TUNING.borders_per_m * STEP_M))


@pytest.mark.parametrize("seed", range(2))
def test_no_history_is_likelier_than_the_one_that_is_found(seed: int) -> None:
    """All with at most two borders. Borders show by what follows, so the last steps have none."""
    rng = np.random.default_rng(seed)
    levels = rng.choice([0.02, 0.06, 0.1, 0.25], 3, replace=False)
    raw = levels[np.minimum(np.arange(30) // 10, 2)] + white_noise(WHITE, 30, rng)
    histories = [h for count in range(3) for h in itertools.combinations(range(1, 30), count)]
    likeliest = max(histories, key=lambda history: evidence(raw, history))
    assert borders_after(level_steps(raw), tuning=replace(TUNING, likely=1e12))[-1] == likeliest


def test_one_ground_has_no_border_and_a_jolt_is_none() -> None:
    raw = 0.05 + white_noise(WHITE, 400, np.random.default_rng(1))
    raw[200:203] += 0.3
    assert borders_after(level_steps(raw))[-1] == ()


def test_histories_are_few_and_forget_what_nobody_asks_for() -> None:
    raw = np.where(np.arange(2000) // 100 % 2, 0.02, 0.12) + white_noise(WHITE, 2000, np.random.default_rng(3))
    search = BorderSearch(300)
    for index, step in enumerate(level_steps(raw)):
        history = search.update(index, step, step.raw, R)
        assert len(search._borders) == search._rows.shape[1] <= MOST
    assert len(history) in (3, 4)
    assert all(border > 1500 for border in history)


def test_after_a_long_way_of_which_nothing_is_known_another_ground_is_no_surprise() -> None:
    """A minute of digging: a difference too small for a border at 0.1 m is one after 60 m."""
    raw = 0.03 + 0.02 * (np.arange(60) >= 40)
    near = level_steps(raw)
    far = [replace(step, distance_m=60.0) if index == 40 else step for index, step in enumerate(near)]
    assert borders_after(near)[-1] == ()
    assert borders_after(far)[-1] == (40,)
    endless = [replace(step, distance_m=1e6) if index == 40 else step for index, step in enumerate(near)]
    assert borders_after(endless)[-1] == (40,)


def test_a_machine_that_stands_crosses_no_border() -> None:
    steps = [replace(step, distance_m=0.0) for step in level_steps(0.02 + 0.1 * (np.arange(100) >= 50))]
    assert not any(borders_after(steps))
