"""The filter against least squares, its smoother against the joint Gaussian, borders, memory, and the mass."""

import math
from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
import pytest

from agents.estimation import borders as border_search
from agents.estimation import resistance_kalman
from agents.estimation.balance import BalanceStep
from agents.estimation.borders import FIRST_C_RR, FIRST_STD
from agents.estimation.resistance_kalman import NOISE, WALK, KalmanResistance
from protocol.arrays import Floats
from tests.unit.agents.drives import START_NS
from tests.unit.agents.ground import STEP_S, feed, level_steps, white_noise

QUIET = 0.002  # half of the noise that is assumed at least: none is measured beyond it
NO_BORDERS = {"BORDERS_PER_M": 1e-300}
STILL = {"WALK": 1e-9, **NO_BORDERS}  # a ground that does not change
STEP_NS = round(STEP_S * 1e9)

Tune = Callable[..., None]


@pytest.fixture
def tune(monkeypatch: pytest.MonkeyPatch) -> Tune:
    """Changes constants of the filter, and of the search for borders."""

    def change(**constants: float) -> None:
        for name, value in constants.items():
            homes = [module for module in (resistance_kalman, border_search) if hasattr(module, name)]
            assert homes, name
            for module in homes:
                monkeypatch.setattr(module, name, value)

    return change


def fed(raw: Iterable[float]) -> KalmanResistance:
    kalman = KalmanResistance()
    feed(kalman, level_steps(raw))
    return kalman


def at_step(kalman: KalmanResistance, index: int) -> tuple[float, float]:
    return kalman.at(START_NS + index * STEP_NS)


def borders(kalman: KalmanResistance) -> list[int]:
    """Indices of steps since the start that begin a new ground."""
    return [round((s.measured.step.stamp_ns - START_NS) / STEP_NS) for s in kalman._steps if s.border]


def nearest_border(kalman: KalmanResistance, index: int) -> int:
    """How many steps the nearest one is off."""
    return min((abs(i - index) for i in borders(kalman)), default=99)


def scale_of(kalman: KalmanResistance) -> tuple[float, float]:
    """Scale error and its variance."""
    newest = kalman._steps[-1]
    return float(newest.x[2]), float(newest.P[2, 2])


# --- one ground ------------------------------------------------------------------------------------------------------


def test_on_one_ground_it_is_weighted_least_squares(tune: Tune) -> None:
    tune(**STILL)
    seed = 1
    rng = np.random.default_rng(seed)
    raw = 0.05 + white_noise(QUIET, 80, rng)
    steps = level_steps(raw)
    steps = [replace(s, dt_s=0.05 / (1 + i % 3), regressor=-0.9 if i % 2 else 1.0) for i, s in enumerate(steps)]
    steps = [replace(s, raw=s.regressor * s.raw) for s in steps]
    kalman = KalmanResistance()
    feed(kalman, steps)
    h, weights = np.array([s.regressor for s in steps]), np.array([s.dt_s for s in steps]) / 0.004**2
    precision = (weights * h**2).sum() + 1 / FIRST_STD**2
    expected = ((weights * h * [s.raw for s in steps]).sum() + FIRST_C_RR / FIRST_STD**2) / precision
    for index in (0, 40, 79):  # a ground that does not change is known alike everywhere
        assert at_step(kalman, index) == pytest.approx((expected, 1 / precision), rel=1e-6), f"{seed=}"


@pytest.mark.parametrize(("border", "wheelbase_m"), [(12, 0.0), (None, 0.5), (12, 0.5)])
def test_smoother_is_the_joint_gaussian(tune: Tune, border: int | None, wheelbase_m: float) -> None:
    """All states at once: c_rr walks, jumps where a border is; a step sees the ground of both axles."""
    seed, n = 2, 30
    rng = np.random.default_rng(seed)
    tune(WALK=0.02, JUMP_STD=0.08, **NO_BORDERS)
    kalman = KalmanResistance()
    raw = 0.05 + np.cumsum(0.003 * rng.standard_normal(n)) + white_noise(QUIET, n, rng)
    feed(kalman, [replace(s, lead_share=0.6, wheelbase_m=wheelbase_m, lead_m=0.2) for s in level_steps(raw)])
    if border:
        kalman._set_borders({border + 1})
    x, P = joint(raw, border, wheelbase_m)
    for index in range(n):
        centre = index
        if border and wheelbase_m and 0 <= index - border < 2:  # 0.2 m ahead of it: the load centre has not come up
            centre = border - 1
        assert at_step(kalman, index) == pytest.approx((x[centre], P[centre, centre]), rel=1e-3), f"{seed=} {index=}"


def joint(raw: Floats, border: int | None, wheelbase_m: float = 0.0) -> tuple[Floats, Floats]:
    """Posterior mean (n,) and covariance (n, n) of c_rr under the leading axle at all steps."""
    n = len(raw)
    walk = resistance_kalman.WALK**2 * 2.0 * STEP_S
    mean, variance = np.full(n, FIRST_C_RR), FIRST_STD**2 + walk * np.arange(1, n + 1)
    new = np.zeros(n, bool)
    if border is not None:  # what was known before is forgotten but for the value
        new[border:] = True
        mean[border:] = joint(raw[:border], None)[0][-1]
        variance[border:] = border_search.JUMP_STD**2 + walk * np.arange(1, n - border + 1)
    prior = np.where(new[:, None] == new, np.minimum(variance[:, None], variance), 0.0)
    H = np.eye(n)
    if border is not None and wheelbase_m:
        for i in range(border, border + round(wheelbase_m / 0.1)):  # until the trailing axle has come up
            H[i, i], H[i, border - 1] = 0.6, 0.4
    gain = prior @ H.T @ np.linalg.inv(H @ prior @ H.T + NOISE**2 / STEP_S * np.eye(n))
    return mean + gain @ (raw - H @ mean), prior - gain @ H @ prior


def test_smoother_with_the_mass_is_the_joint_gaussian(tune: Tune) -> None:
    """Two states that walk, by one large least squares."""
    seed, n = 3, 25
    rng = np.random.default_rng(seed)
    tune(**NO_BORDERS, WALK=0.01, SCALE_WALK=0.01, SCALE_STD=0.1)
    share = 0.1 + 0.1 * rng.standard_normal(n)
    raw = 0.05 + 0.03 * share + white_noise(QUIET, n, rng)
    kalman = KalmanResistance(estimates_mass=True)
    feed(kalman, level_steps(raw, share=share))
    q = np.array([0.01**2 * 2.0 * STEP_S, 0.01**2 * STEP_S])
    rows, values, weights = [], [], []
    for i in range(n):
        for state in range(2):  # prior of the first, walks between
            row = np.zeros(2 * n)
            row[2 * i + state] = 1.0
            if i:
                row[2 * i - 2 + state] = -1.0
            first = (FIRST_STD**2, 0.1**2)[state]
            rows.append(row)
            values.append((FIRST_C_RR, 0.0)[state] if not i else 0.0)
            weights.append(1 / (q[state] if i else q[state] + first))
        row = np.zeros(2 * n)
        row[2 * i : 2 * i + 2] = 1.0, share[i]
        rows.append(row)
        values.append(raw[i])
        weights.append(STEP_S / NOISE**2)
    A, W = np.array(rows), np.array(weights)
    information = A.T @ (W[:, None] * A)
    x, P = np.linalg.solve(information, A.T @ (W * values)), np.linalg.inv(information)
    for i in range(n):
        assert at_step(kalman, i) == pytest.approx((x[2 * i], P[2 * i, 2 * i]), rel=1e-3), f"{seed=} {i=}"


@pytest.mark.slow
def test_normalised_error_is_one_where_the_ground_wanders_as_assumed(tune: Tune) -> None:
    tune(**NO_BORDERS)
    seed = 4
    rng = np.random.default_rng(seed)
    errors = []
    for _ in range(60):
        truth = FIRST_C_RR + np.cumsum(WALK * math.sqrt(2.0 * STEP_S) * rng.standard_normal(180))
        kalman = fed(truth + white_noise(NOISE, 180, rng))
        for index in (60, 120, 179):
            c_rr, variance = at_step(kalman, index)
            errors.append((c_rr - truth[index]) / math.sqrt(variance))
    rms = float(np.sqrt(np.mean(np.square(errors))))
    assert 0.85 < rms < 1.15, f"{seed=} {rms=}"


@pytest.mark.slow
def test_noise_is_measured_where_it_is_more_than_assumed(tune: Tune) -> None:
    tune(**STILL)
    seed, density, errors = 6, 0.012, []
    rng = np.random.default_rng(seed)
    for _ in range(8):
        kalman = fed(0.05 + white_noise(density, 1600, rng))
        c_rr, variance = at_step(kalman, 1599)
        assert variance == pytest.approx(density**2 / 80, rel=0.5)
        errors.append((c_rr - 0.05) / math.sqrt(variance))
    rms = float(np.sqrt(np.mean(np.square(errors))))
    assert 0.7 < rms < 1.4, f"{seed=} {rms=}"


def test_borders_pauses_and_turns_back_are_not_mistaken_for_noise(tune: Tune) -> None:
    tune(**STILL)
    steps = level_steps(np.full(600, 0.05))
    steps = [replace(s, raw=s.raw + 0.1 * (i // 100 % 2)) for i, s in enumerate(steps)]  # borders
    steps = [
        replace(s, raw=-s.raw, regressor=-1.0) if i // 50 % 2 else s for i, s in enumerate(steps)
    ]  # there and back
    kalman = KalmanResistance()
    feed(kalman, steps)
    assert kalman._noise.density < 1.2 * 0.004**2


# --- borders ---------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_border_is_dated_to_where_it_began(tune: Tune) -> None:
    tune(NOISE=0.002)
    before, step, is_dated = 100, -0.02, []
    for seed in range(15):
        rng = np.random.default_rng(seed)
        raw = 0.05 + np.where(np.arange(before + 50) < before, 0.0, step) + white_noise(0.002, before + 50, rng)
        kalman = fed(raw)
        is_dated.append(nearest_border(kalman, before) <= 2)
        assert len(borders(kalman)) == 1, f"{seed=}"
    assert sum(is_dated) >= 13


def test_estimates_keep_to_their_side_of_a_border(tune: Tune) -> None:
    """Half a second before and behind a clear border each ground has its own value, and none in between."""
    rng = np.random.default_rng(7)
    raw = 0.02 + 0.1 * (np.arange(140) >= 100) + white_noise(0.004, 140, rng)
    kalman = fed(raw)
    assert abs(borders(kalman)[0] - 100) <= 2
    for index in [*range(60, 98), *range(104, 140)]:
        c_rr, variance = at_step(kalman, index)
        assert abs(c_rr - (0.02 if index < 100 else 0.12)) < 4 * math.sqrt(variance) < 0.06
    tune(**NO_BORDERS)
    assert abs(at_step(fed(raw), 105)[0] - 0.12) > 0.01


@pytest.mark.nightly
@pytest.mark.slow
def test_one_ground_has_no_border() -> None:
    """Five minutes of each of ten machines."""
    marked: set[tuple[int, int]] = set()
    for seed in range(10):
        kalman = KalmanResistance()
        for step in level_steps(0.05 + white_noise(0.004, 6000, np.random.default_rng(seed))):
            kalman.update(step)
            marked |= {(seed, s.measured.step.stamp_ns) for s in kalman._steps[-40:] if s.border}
    assert len(marked) <= 1


@pytest.mark.parametrize("limit", [NO_BORDERS, {"COLOURED": 100.0}, {"UNEVEN": 0.2}], ids=str)
def test_what_is_no_border(tune: Tune, limit: dict[str, float]) -> None:
    raw = 0.03 + 0.03 * (np.arange(80) >= 60)
    assert borders(fed(raw))
    tune(**limit)
    assert not borders(fed(raw))


@pytest.mark.slow
def test_a_border_is_taken_back_where_it_was_a_bump() -> None:
    """A second of noise that goes one way may look like a border, until what comes next is as before."""
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
    """A machine whose front axle is at way 0 first drives over a border; no noise."""
    steps: list[BalanceStep] = []
    for step in level_steps(np.zeros(round(metres / 0.1))):
        lead_m = 0.1 * (len(steps) + 1)
        lead, trail = (behind if m > at_m else before for m in (lead_m, lead_m - 3.3))
        steps.append(replace(step, raw=0.45 * lead + 0.55 * trail, **AXLES))  # type: ignore[arg-type]
    return steps


@pytest.mark.parametrize(("before", "behind"), [(0.02, 0.08), (0.09, 0.04), (0.01, 0.25)])
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
    """The front axle 1 m on the new ground, then home: the old ground is found again behind."""
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
    estimate = kalman.at(home[-1].stamp_ns)
    assert estimate[0] == pytest.approx(0.03, abs=0.01)


# --- asked and remembered --------------------------------------------------------------------------------------------


def test_memory_is_bounded_and_answers_stay_right(tune: Tune) -> None:
    tune(**STILL)
    rng = np.random.default_rng(8)
    raw = 0.05 + white_noise(QUIET, 3000, rng)
    kalman, recent = KalmanResistance(), KalmanResistance()
    steps = level_steps(raw)
    feed(kalman, steps)
    assert len(kalman._steps) <= 2 * resistance_kalman.KEPT
    assert at_step(kalman, 2999)[0] == pytest.approx(raw.mean(), abs=1e-6)
    assert at_step(kalman, 2999)[1] == pytest.approx(0.004**2 / (3000 * STEP_S), rel=1e-3)
    assert at_step(kalman, 2910)[0] == pytest.approx(raw.mean(), abs=1e-6)
    assert kalman.at(START_NS) is None
    feed(recent, steps[:1])
    assert recent.at(START_NS)


def test_forgetting_old_steps_changes_no_recent_estimate() -> None:
    """Once more with what was filtered when 100 steps are forgotten, from a longer memory."""
    rng = np.random.default_rng(9)
    raw = 0.05 + 0.04 * (np.arange(450) >= 195) + white_noise(QUIET, 450, rng)
    kalman, tail = fed(raw), KalmanResistance()
    tail._first = fed(raw[:350])._steps[-1]
    feed(tail, level_steps(raw)[350:])
    for index in (445, 400, 370):
        assert at_step(kalman, index) == pytest.approx(at_step(tail, index), rel=1e-9)


def test_only_a_stamp_near_a_step_has_an_estimate() -> None:
    kalman = KalmanResistance()
    assert kalman.at(START_NS) is None
    first, second = level_steps(np.full(20, 0.05)), level_steps(np.full(20, 0.05))
    later = [replace(s, stamp_ns=s.stamp_ns + 5 * 10**9) for s in second]
    feed(kalman, [*first, *later])
    end = first[-1].stamp_ns
    for stamp, known in (
        (START_NS - 140_000_000, True),
        (START_NS - 160_000_000, False),
        (end + 140_000_000, True),
        (end + 160_000_000, False),
        (later[0].stamp_ns - 160_000_000, False),
        (later[0].stamp_ns - 140_000_000, True),
        (later[-1].stamp_ns + 140_000_000, True),
        (later[-1].stamp_ns + 160_000_000, False),
    ):
        assert (kalman.at(stamp) is not None) is known, stamp


# --- the mass --------------------------------------------------------------------------------------------------------


def at_work(scale: float, seconds: float, seed: int, c_rr: float = 0.05, start: int = 0) -> list[BalanceStep]:
    """A loader that accelerates and climbs; drive force over the mass that it believes in is off by a scale."""
    rng = np.random.default_rng(seed)
    n = round(seconds / STEP_S)
    taken = 0.08 * np.sin(0.05 * np.arange(n)) + 0.04 * np.sin(0.013 * np.arange(n))
    share = (1 + scale) * (c_rr + taken)  # what it reads
    steps = level_steps(share - taken + white_noise(0.004, n, rng), share=share)
    return [replace(s, stamp_ns=s.stamp_ns + start * STEP_NS) for s in steps]


@pytest.mark.slow
def test_wrong_mass_is_found_where_forces_vary() -> None:
    """raw = c_rr + scale error / (1 + ...) * share: what drives in excess of what the motion takes."""
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


def test_stop_without_loading_changes_nothing() -> None:
    a, b = KalmanResistance(estimates_mass=True), KalmanResistance(estimates_mass=True)
    for kalman in (a, b):
        feed(kalman, at_work(0.1, 20, 1))
    a.stand(changes_load=False)
    for kalman in (a, b):
        feed(kalman, at_work(0.1, 2, 2, start=500))
    assert scale_of(a) == scale_of(b)


def test_mass_that_is_known_stays_known() -> None:
    kalman = KalmanResistance()
    feed(kalman, at_work(0.2, 30, 1))
    kalman.stand(changes_load=True)
    feed(kalman, at_work(0.2, 30, 1, start=700))
    assert scale_of(kalman) == (0.0, 0.0)


@pytest.mark.parametrize("steps", [30, 230])
def test_recalibrated_is_as_if_all_steps_had_had_the_new_calibration(steps: int) -> None:
    rng = np.random.default_rng(3)
    raw = np.where(np.arange(300) < steps - 20, 0.04, 0.1) + white_noise(NOISE, 300, rng)
    changed = fed(raw[:steps])
    before = borders(changed)
    assert before
    changed.recalibrate(0.005, 0.1)
    assert borders(changed) == before
    new = raw - 0.005 - 0.1 * 0.04
    feed(changed, level_steps(new)[steps:])
    always = fed(new)
    assert borders(changed) == borders(always)
    for index in range(max(250 - resistance_kalman.KEPT, 20), 300, 7):
        assert at_step(changed, index) == pytest.approx(at_step(always, index), abs=3e-5)


def test_a_change_of_the_calibration_is_no_border() -> None:
    kalman = fed(np.full(200, 0.04))
    kalman.recalibrate(0.02, 0.0)
    feed(kalman, level_steps(np.full(300, 0.02))[200:])
    assert not borders(kalman)
    for index in (150, 199, 200, 250):
        assert at_step(kalman, index)[0] == pytest.approx(0.02, abs=1e-6)


def test_a_calibration_counts_by_direction() -> None:
    kalman = KalmanResistance()
    reverse = [replace(step, regressor=-1.0, raw=-0.04) for step in level_steps(np.zeros(100))]
    feed(kalman, reverse)
    kalman.recalibrate(0.02, 0.0)
    assert at_step(kalman, 99)[0] == pytest.approx(0.06, abs=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("reverse", [1, 20])
def test_a_change_of_the_calibration_soon_after_a_turn_is_no_border(reverse: int) -> None:
    """A zero counts with opposite signs ahead and in reverse, so what both say of one ground is not shifted by it."""
    rng = np.random.default_rng(11)
    n, zero = 300 + reverse + 100, 0.01
    direction = np.where(np.arange(n) < 300, 1.0, -1.0)
    raw = direction * 0.04 + zero + white_noise(NOISE, n, rng)
    steps = [replace(s, regressor=d, raw=r) for s, d, r in zip(level_steps(raw), direction, raw, strict=True)]
    kalman = KalmanResistance()
    feed(kalman, steps[: 300 + reverse])
    kalman.recalibrate(zero, 0.0)
    feed(kalman, [replace(s, raw=s.raw - zero) for s in steps[300 + reverse :]])
    assert not [border for border in borders(kalman) if border >= 300 + reverse]
    assert at_step(kalman, n - 1)[0] == pytest.approx(0.04, abs=4e-3)
