import itertools
import math
import os
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

from agents.localisation.filters.belief import Belief, Filter, Measurement, Motion
from agents.localisation.filters.ekf import Ekf
from agents.localisation.filters.motion import GpsError, MotionModel, map_from_base, motion
from agents.localisation.filters.square_root import definite, factor, root, wrapped
from agents.localisation.filters.state import ATTITUDE, PITCH, POSITION, RATE, ROLL, VELOCITY, YAW, Layout
from agents.localisation.filters.ukf import Ukf
from protocol.arrays import Floats

# Steps of each filter in every run; a million were taken with this variable set.
STEPS = int(os.environ.get("SITEGRID_FILTER_STEPS", "6000"))
PAPER_UKF, SMALL_UKF = Ukf(alpha=1.0, beta=2.0), Ukf(alpha=1e-3, beta=2.0, kappa=0.0)
BOTH = [Ekf(), Ukf()]
ALL = [*BOTH, PAPER_UKF, SMALL_UKF]
LAYOUT = Layout(imus=1, wheel_scale=True, receivers=2)
MODEL = MotionModel(LAYOUT, gps_errors=(GpsError(3.0, 45.0), GpsError(1.5, 20.0)))
PLANE = replace(MODEL, on_plane=True)
ANGLES_OF = {1: (0,), 4: (0, 1)}  # of the sensors in the long run
LEVER_M = np.array([0.8, 0.3, 3.0])


def name(value: Any) -> str | None:
    return f"{type(value).__name__}-{value.alpha}" if isinstance(value, Ukf) else None


def frozen(values: Any) -> Floats:
    """An array that nobody can write to, so that a filter which changes its input fails."""
    array = np.array(values, dtype=float)
    array.setflags(write=False)
    return array


def believed(x: Any, P: Any) -> Belief:
    return Belief(0, frozen(x), frozen(P))


def linear(z: Any, H: Any, R: Any, **options: Any) -> Measurement:
    H = frozen(H)
    return Measurement("a", 0, frozen(z), frozen(R), lambda states: states @ H.T, lambda _: H, **options)


def covariance(rng: np.random.Generator, n: int, scale: float = 1.0) -> Floats:
    root = rng.normal(size=(n, n)) * scale
    return root @ root.T + 0.1 * scale**2 * np.eye(n)


def antenna(receiver: int, z: Any, R: Any, **options: Any) -> Measurement:
    """A GPS fix (east, north) with a lever arm and the receiver's error: not linear in the attitude."""
    error = LAYOUT.gps_error(receiver)
    h = 1e-6

    def fix(states: Floats) -> Floats:
        arms = np.array([map_from_base(attitude) @ LEVER_M for attitude in states[:, ATTITUDE]])
        return states[:, :2] + arms[:, :2] + states[:, error]

    def slopes(x: Floats) -> Floats:
        return (fix(x + h * np.eye(len(x))) - fix(x - h * np.eye(len(x)))).T / (2 * h)

    return Measurement(f"gps-{receiver}", 0, frozen(z), frozen(R), fix, slopes, **options)


def pick(states: Any, z: Any, R: Any, **options: Any) -> Measurement:
    """A measurement of some states as they are."""
    return linear(z, np.eye(LAYOUT.n)[states], R, **options)


def definite_enough(P: Floats) -> bool:
    """Positive definite whatever the units: scaled to ones on the diagonal."""
    scale = np.sqrt(np.diag(P))
    return bool(np.linalg.eigvalsh(P / np.outer(scale, scale))[0] > 0)


# --- the Kalman filter -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ALL, ids=name)
def test_on_a_linear_model_it_is_the_kalman_filter(kind: Filter) -> None:
    seed, n = 1, 6
    rng = np.random.default_rng(seed)
    F = np.eye(n) + 0.1 * rng.normal(size=(n, n))
    F /= np.abs(np.linalg.eigvals(F)).max()
    Q = covariance(rng, n, 0.1)
    moves = Motion(lambda states: states @ F.T, lambda _: F, frozen(Q), ())
    x, P = rng.normal(size=n), covariance(rng, n)
    belief = believed(x, P)
    for step in range(200):
        belief = kind.predict(belief, moves, step)
        x, P = F @ x, F @ P @ F.T + Q
        for k in range(rng.integers(0, 4)):
            H, R, z = rng.normal(size=(k + 1, n)), covariance(rng, k + 1), rng.normal(size=k + 1)
            S, y = H @ P @ H.T + R, z - H @ x
            K = P @ H.T @ np.linalg.inv(S)
            conditioned = kind.condition(belief, linear(z, H, R))
            belief = conditioned.belief
            x, P = x + K @ y, P - K @ S @ K.T
            np.testing.assert_allclose(conditioned.innovation, y, atol=1e-6, err_msg=f"{seed=}")
            np.testing.assert_allclose(conditioned.innovation_covariance, S, rtol=1e-6, atol=1e-6, err_msg=f"{seed=}")
            assert conditioned.nis == pytest.approx(y @ np.linalg.inv(S) @ y, rel=1e-5)
        np.testing.assert_allclose(belief.x, x, rtol=1e-6, atol=1e-6, err_msg=f"{seed=} {step=}")
        np.testing.assert_allclose(belief.P, P, rtol=1e-6, atol=1e-6, err_msg=f"{seed=} {step=}")
        assert belief.stamp_ns == step


@pytest.mark.parametrize("kind", BOTH, ids=name)
def test_measurements_one_after_another_equal_the_stacked_one(kind: Filter) -> None:
    rng = np.random.default_rng(3)
    belief = believed(rng.normal(size=5), covariance(rng, 5))
    H, variance, z = rng.normal(size=(4, 5)), rng.uniform(0.1, 2.0, 4), rng.normal(size=4)
    stacked = kind.condition(belief, linear(z, H, np.diag(variance))).belief
    for order in itertools.permutations(range(4)):
        single = belief
        for i in order:
            single = kind.condition(single, linear(z[[i]], H[[i]], [[variance[i]]])).belief
        np.testing.assert_allclose(single.x, stacked.x, atol=1e-12)
        np.testing.assert_allclose(single.P, stacked.P, atol=1e-12)


# --- first order -----------------------------------------------------------------------------------------------------


def small(scale: float) -> tuple[Belief, Motion, list[Measurement]]:
    """A belief, its motion and measurements, whose standard deviations and innovations all grow with the scale."""
    rng = np.random.default_rng(11)
    x = rng.normal(size=LAYOUT.n)
    x[ATTITUDE] = 0.2, -0.4, 2.0
    belief = believed(x, covariance(rng, LAYOUT.n, 0.2) * scale**2)
    moves = motion(MODEL, belief, 0.1)
    after = moves.f(x[None])
    R = np.eye(2) * 0.3 * scale**2
    fixes = [antenna(i, antenna(i, [0, 0], R).h(after)[0] + scale * rng.normal(size=2), R) for i in (0, 1)]
    yaw = pick([YAW], after[0, [YAW]] + 0.2 * scale, R[:1, :1], angles=(0,))
    return belief, replace(moves, Q=moves.Q * scale**2), [*fixes, yaw]


def run(kind: Filter, belief: Belief, moves: Motion, measurements: Any) -> Belief:
    belief = kind.predict(belief, moves, 1)
    for measurement in measurements:
        belief = kind.condition(belief, measurement).belief
    return belief


@pytest.mark.parametrize("kind", ALL[1:], ids=name)
@pytest.mark.parametrize("scale", [1e-2, 1e-3])
def test_ukf_equals_ekf_to_first_order(kind: Filter, scale: float) -> None:
    """A tenth of the deviation: a hundredth of the difference in the mean, and in the share of the covariance."""
    mine, ekf = (run(each, *small(scale)) for each in (kind, Ekf()))
    assert np.abs(mine.x - ekf.x).max() < 5 * scale**2
    assert np.abs(mine.P - ekf.P).max() < 5 * scale * np.abs(ekf.P).max()


@pytest.mark.slow
def test_ukf_is_nearer_to_the_truth_than_ekf_where_the_heading_is_uncertain() -> None:
    """Ten metres driven with a heading known to 0.5 rad: moments of 200 000 drawn states."""
    x = np.zeros(15)
    x[VELOCITY] = 10.0, 0.0, 0.0
    P = np.diag([*[0.01] * 5, 0.25, *[0.01] * 9])
    belief = believed(x, P)
    moves = replace(motion(MotionModel(Layout()), belief, 1.0), Q=np.zeros((15, 15)))
    drawn = moves.f(np.random.default_rng(0).multivariate_normal(x, P, 200_000))[:, :2]
    errors = []
    for kind in BOTH:
        after = kind.predict(belief, moves, 1)
        mean = np.abs(after.x[:2] - drawn.mean(axis=0)).max()
        errors.append((mean, np.abs(after.P[:2, :2] - np.cov(drawn.T)).max()))
    (ekf_mean, ekf_P), (ukf_mean, ukf_P) = errors
    assert ukf_mean < 0.02 * ekf_mean
    assert ukf_P < 0.4 * ekf_P


@pytest.mark.parametrize("kind", BOTH, ids=name)
def test_a_machine_that_reckons_moves_as_its_mean_does_and_is_as_unsure_of_it(kind: Filter) -> None:
    """A heading known to 0.5 rad: the mean of all places lies a metre short, at the centre of an arc's chord."""
    x = np.zeros(15)
    x[VELOCITY] = 10.0, 0.0, 0.0
    belief = believed(x, np.diag([*[0.01] * 5, 0.25, *[0.01] * 9]))
    model = MotionModel(Layout())
    reckoned, placed = (
        kind.predict(belief, motion(replace(model, reckons=reckons), belief, 1.0), 1) for reckons in (True, False)
    )
    np.testing.assert_allclose(reckoned.x, motion(model, belief, 1.0).f(x[None])[0])
    np.testing.assert_array_equal(reckoned.P, placed.P)
    assert reckoned.P[0, 0] > (reckoned.x[0] - placed.x[0]) ** 2


@pytest.mark.slow
@pytest.mark.parametrize("kind", BOTH, ids=name)
def test_it_is_as_sure_as_it_is_right(kind: Filter) -> None:
    """NEES of drives drawn from the model itself: 21 states, 100 drives, so a mean of 21 +- 0.65."""
    seed, n = 17, LAYOUT.n
    rng = np.random.default_rng(seed)
    nees = []
    for _ in range(100):
        x = np.zeros(n)
        x[ATTITUDE], x[VELOCITY], x[RATE] = (0.1, -0.1, 2.5), (3.0, 0.0, 0.0), (0.0, 0.0, 0.4)
        deviation = np.concatenate([[1.0] * 3, [0.1] * 12, [0.01, 0.03], [1.7, 1.7, 1.2, 1.2]])
        truth, belief = x + deviation * rng.normal(size=n), believed(x, np.diag(deviation**2))
        for step in range(20):
            drift = motion(MODEL, believed(truth, belief.P), 0.1)
            truth = drift.f(truth[None])[0] + factor(drift.Q + 1e-15 * np.eye(n)) @ rng.normal(size=n)
            belief = kind.predict(belief, motion(MODEL, belief, 0.1), step)
            for measured in _measured(truth, rng):
                belief = kind.condition(belief, measured).belief
        error = wrapped(truth - belief.x, (3, 4, 5))
        nees.append(error @ np.linalg.solve(belief.P, error))
    assert np.mean(nees) == pytest.approx(n, abs=2.0), f"{seed=}"


def _measured(truth: Floats, rng: np.random.Generator) -> list[Measurement]:
    """By two receivers, a gyro, the wheels and a tilt sensor, with their noise."""
    measured = [
        antenna(i, antenna(i, [0, 0], np.eye(2)).h(truth[None])[0] + rng.normal(size=2), np.eye(2)) for i in (0, 1)
    ]
    for states, variance in ((RATE, 1e-4), (VELOCITY, 1e-2), (slice(ROLL, YAW), 1e-3)):
        picked = list(range(*states.indices(15)))
        z = truth[states] + math.sqrt(variance) * rng.normal(size=len(picked))
        measured.append(pick(picked, z, np.eye(len(picked)) * variance))
    return measured


# --- the unscented transform -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ALL[1:], ids=name)
@pytest.mark.parametrize("n", [2, 15, 21])
def test_sigma_points_have_the_weights_of_filterpy(kind: Ukf, n: int) -> None:
    points = kind._points(n, 2)
    stock = MerweScaledSigmaPoints(n, kind.alpha, kind.beta, 3.0 - n if kind.kappa is None else kind.kappa)
    assert pytest.approx(stock.Wm[1]) == points.W
    assert stock.Wc[0] - stock.Wm[0] == pytest.approx(1 + points.surplus)


@pytest.mark.parametrize("kind", [Ukf(), PAPER_UKF, Ukf(alpha=0.5, beta=2.0, kappa=0.0)], ids=name)
def test_its_steps_are_filterpys(kind: Ukf) -> None:
    """Where filterpy's own weighted sums are well conditioned they are the same, motion and measurement not linear."""
    belief, moves, measurements = small(0.3)
    n = len(belief.x)
    kappa = 3.0 - n if kind.kappa is None else kind.kappa
    points = MerweScaledSigmaPoints(n, kind.alpha, kind.beta, kappa)
    hx, fx = (lambda s: measurements[0].h(s[None])[0]), (lambda s, _: moves.f(s[None])[0])
    stock = UnscentedKalmanFilter(n, 2, 0.1, hx, fx, points)
    stock.x, stock.P, stock.Q = belief.x, belief.P, moves.Q
    stock.predict()
    stock.update(measurements[0].z, R=measurements[0].R)
    mine = run(kind, belief, replace(moves, angles=()), measurements[:1])
    np.testing.assert_allclose(mine.x, stock.x, atol=1e-10)
    np.testing.assert_allclose(mine.P, stock.P, atol=1e-10)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"alpha": 0.0}, "alpha"),
        ({"alpha": math.nan}, "alpha"),
        ({"alpha": 1.0, "beta": 0.9}, "beta"),
        ({"beta": math.inf}, "beta"),
        ({"kappa": math.nan}, "kappa"),
    ],
)
def test_bad_option_is_refused_by_name(options: dict[str, float], named: str) -> None:
    with pytest.raises(ValueError, match=named):
        Ukf(**options)


def test_kappa_too_small_for_the_state_is_refused() -> None:
    with pytest.raises(ValueError, match="kappa"):
        Ukf(kappa=-3.0).condition(believed(np.zeros(2), np.eye(2)), linear([0.0], [[1.0, 0.0]], [[1.0]]))


# --- what is refused -------------------------------------------------------------------------------------------------

BAD_R = [
    [[math.nan, 0.0], [0.0, 1.0]],
    [[1.0, 0.0], [math.nan, 1.0]],
    [[1.0, math.nan], [0.0, 1.0]],
    [[math.inf, 0.0], [0.0, 1.0]],
    [[0.0, 0.0], [0.0, 0.0]],
    [[1.0, 0.0], [0.0, 0.0]],
    [[-1.0, 0.0], [0.0, 1.0]],
    [[1.0, 2.0], [2.0, 1.0]],
]


@pytest.mark.parametrize("kind", BOTH, ids=name)
@pytest.mark.parametrize("R", BAD_R)
def test_a_bad_covariance_leaves_the_belief_unchanged(kind: Filter, R: Any) -> None:
    belief = believed(np.zeros(3), np.eye(3))
    conditioned = kind.condition(belief, linear([1.0, 2.0], np.eye(3)[:2], R))
    assert not conditioned.accepted
    assert conditioned.belief is belief
    assert math.isnan(conditioned.nis)
    assert (conditioned.innovation.shape, conditioned.innovation_covariance.shape) == ((2,), (2, 2))


@pytest.mark.parametrize("kind", BOTH, ids=name)
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_measurement_that_is_not_finite_leaves_the_belief_unchanged(kind: Filter, value: float) -> None:
    belief = believed(np.zeros(3), np.eye(3))
    assert kind.condition(belief, linear([1.0, value], np.eye(3)[:2], np.eye(2))).belief is belief
    blind = replace(linear([1.0, 0.0], np.eye(3)[:2], np.eye(2)), h=lambda states: np.full((len(states), 2), math.nan))
    assert kind.condition(belief, blind).belief is belief


@pytest.mark.parametrize("kind", BOTH, ids=name)
def test_the_gate_counts_in_standard_deviations_of_the_innovation(kind: Filter) -> None:
    """State and measurement of variance 1 each: 3 sigma are 4.24 away."""
    belief = believed(np.zeros(3), np.eye(3))
    near, far = ([4.2], [4.3])
    assert kind.condition(belief, linear(near, np.eye(3)[:1], [[1.0]], gate_sigma=3.0)).accepted
    gated = kind.condition(belief, linear(far, np.eye(3)[:1], [[1.0]], gate_sigma=3.0))
    assert not gated.accepted
    assert gated.belief is belief
    assert gated.nis == pytest.approx(4.3**2 / 2)
    assert kind.condition(belief, linear([1e6], np.eye(3)[:1], [[1.0]])).accepted


# --- angles ----------------------------------------------------------------------------------------------------------


def test_wrapping_touches_angles_alone() -> None:
    values = frozen([[4.0, 4.0], [-4.0, -4.0]])
    np.testing.assert_allclose(wrapped(values, (1,)), [[4.0, 4.0 - math.tau], [-4.0, math.tau - 4.0]])


@pytest.mark.slow
@pytest.mark.parametrize("kind", BOTH, ids=name)
@pytest.mark.parametrize("turned", [math.pi, -2.0])
def test_where_east_lies_does_not_matter(kind: Filter, turned: float) -> None:
    """A drive of four turns in a map that is turned by any angle is the drive turned: across +-pi nothing jumps.

    Exact for the EKF. Sigma points follow the axes of the map, so for the UKF it is exact at half a turn only.
    """
    exact = isinstance(kind, Ekf) or turned == math.pi
    turn = map_from_base(np.array([0.0, 0.0, turned]))[:2, :2]
    R, shift = np.eye(LAYOUT.n), turned * np.eye(LAYOUT.n)[YAW]
    for i in (0, *range(LAYOUT.gps_errors.start, LAYOUT.n, 2)):
        R[i : i + 2, i : i + 2] = turn
    rng = np.random.default_rng(8)
    x = np.zeros(LAYOUT.n)
    x[[VELOCITY.start, RATE.stop - 1]] = 3.0, 0.6
    P = np.eye(LAYOUT.n) * 0.01
    plain, other = believed(x, P), believed(x + shift, P)
    for step in range(210):
        fix, yaw = 5 * rng.normal(size=2), 0.12 * (step + 1) + 0.05 * rng.normal()
        plain = turned_drive(kind, plain, fix, yaw)
        other = turned_drive(kind, other, turn @ fix, yaw + turned)
        assert max(abs(plain.x[YAW]), abs(other.x[YAW])) < math.pi + 0.5  # wrapped when it moves
        difference = wrapped(R @ plain.x + shift - other.x, (YAW,))
        np.testing.assert_allclose(difference, 0.0, atol=1e-7 if exact else 0.05, err_msg=f"{step=}")
        np.testing.assert_allclose(R @ plain.P @ R.T, other.P, atol=1e-7 if exact else 0.05, err_msg=f"{step=}")


def turned_drive(kind: Filter, belief: Belief, fix: Floats, yaw: float) -> Belief:
    moves = motion(PLANE, belief, 0.2)
    speed = pick([VELOCITY.start], [3.0], [[0.01]])
    heading = pick([YAW], [math.remainder(yaw, math.tau)], [[0.01]], angles=(0,))
    return run(kind, belief, moves, [antenna(0, fix, np.eye(2) * 25), speed, heading])


# --- the covariance --------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("kind", BOTH, ids=name)
@pytest.mark.parametrize("model", [MODEL, PLANE], ids=["space", "plane"])
def test_covariance_stays_symmetric_and_definite_through_dropouts_and_extremes(
    kind: Filter, model: MotionModel
) -> None:
    """Sensors vanish for long stretches, and their covariances are anything between 1e-10 and 1e10."""
    seed = 7
    rng = np.random.default_rng(seed)
    start = believed(np.zeros(LAYOUT.n), np.diag(10.0 ** rng.uniform(-6, 4, LAYOUT.n)))
    belief, heard, moves = start, np.ones(5, dtype=bool), motion(model, start, 0.1)
    accepted = 0
    for step in range(STEPS // 2):  # for two of them
        if step % 10 == 0:
            moves = motion(model, belief, float(10.0 ** rng.uniform(-3, 0)))
            heard ^= rng.random(5) < 0.05
        belief = kind.predict(belief, moves, step)
        for sensor in np.flatnonzero(heard & (rng.random(5) < 0.3)):
            conditioned = kind.condition(belief, _any_measurement(int(sensor), rng, belief))
            belief, accepted = conditioned.belief, accepted + conditioned.accepted
        if step % 10 == 0:
            assert np.array_equal(belief.P, belief.P.T), f"{seed=} {step=}"
            assert definite_enough(belief.P), f"{seed=} {step=}"
            assert np.isfinite(belief.x).all(), f"{seed=} {step=}"
    assert accepted > STEPS // 10


def _any_measurement(sensor: int, rng: np.random.Generator, belief: Belief) -> Measurement:
    variance = 10.0 ** rng.uniform(-10, 10) if rng.random() < 0.1 else 10.0 ** rng.uniform(-4, 1)
    states = ([0, 1], [YAW], range(*RATE.indices(15)), range(*VELOCITY.indices(15)), [ROLL, PITCH])
    picked = list(states[sensor])
    z = rng.normal(size=len(picked)) * (10.0 if sensor == 0 else 0.3)
    R = np.eye(len(picked)) * variance
    return antenna(0, z, R, gate_sigma=6.0) if sensor == 0 else pick(picked, z, R, angles=ANGLES_OF.get(sensor, ()))


@pytest.mark.parametrize("kind", BOTH, ids=name)
def test_no_angle_is_less_known_than_to_a_right_angle(kind: Filter) -> None:
    """A machine that nothing is heard of for a day; what is known of the rest stays finite."""
    belief = believed(np.zeros(LAYOUT.n), np.eye(LAYOUT.n) * 0.01)
    for step in range(1000):
        belief = kind.predict(belief, motion(MODEL, belief, 86.4), step)
    assert np.diag(belief.P)[ATTITUDE] == pytest.approx((math.pi / 2) ** 2)
    assert definite_enough(belief.P)
    heard = kind.condition(belief, pick([YAW], [3.0], [[1e-4]], angles=(0,))).belief
    assert math.remainder(heard.x[YAW], math.tau) == pytest.approx(3.0, abs=0.01)


@pytest.mark.parametrize("kind", ALL, ids=name)
def test_a_belief_that_is_not_positive_definite_is_repaired(kind: Filter) -> None:
    rng = np.random.default_rng(2)
    n = LAYOUT.n
    P = covariance(rng, n)
    values, vectors = np.linalg.eigh(P)
    values[:3] = -1e-3, 0.0, -1e-12
    belief = believed(rng.normal(size=n) * 0.1, vectors * values @ vectors.T)
    moves = motion(MODEL, belief, 0.1)
    for after in (kind.predict(belief, moves, 1), kind.condition(belief, antenna(0, [1.0, 2.0], np.eye(2))).belief):
        assert np.array_equal(after.P, after.P.T)
        assert definite_enough(after.P)
        np.testing.assert_allclose(after.P, after.P.T)


def test_repair_changes_little_and_minds_the_units() -> None:
    P = np.diag([1e6, 1e-10, 1.0])
    P[0, 2] = P[2, 0] = 1e3 * (1 + 1e-9)
    repaired = definite(0, np.zeros(3), P).P
    np.testing.assert_allclose(repaired, P, rtol=1e-6)
    root = factor(P)
    np.testing.assert_allclose(root @ root.T, P, rtol=1e-6, atol=1e-18)


@pytest.mark.parametrize("kind", ALL, ids=name)
def test_a_filter_hands_on_the_factor_of_its_covariance(kind: Filter) -> None:
    belief, moves, measurements = small(0.3)
    predicted = kind.predict(belief, moves, 1)
    updated = kind.condition(predicted, measurements[0]).belief
    for each in (predicted, updated):
        assert each.L is root(each)
        np.testing.assert_array_equal(each.L, factor(each.P))
    np.testing.assert_array_equal(root(belief), factor(belief.P))


def test_a_covariance_of_nan_is_an_error() -> None:
    P = np.eye(3)
    P[0, 1] = P[1, 0] = math.nan
    with pytest.raises(ValueError, match="finite"):
        factor(P)


@pytest.mark.parametrize("kind", BOTH, ids=name)
def test_a_measurement_beyond_all_precision_still_leaves_a_covariance(kind: Filter) -> None:
    belief = believed(np.zeros(4), np.eye(4) * 1e8)
    H = [[1.0, 1.0, 0.0, 0.0], [1.0, 1.0 + 1e-12, 0.0, 0.0]]
    after = kind.condition(belief, linear([1.0, 1.0], H, np.eye(2) * 1e-14)).belief
    assert definite_enough(after.P)
    assert after.x[POSITION][:2].sum() == pytest.approx(1.0, abs=1e-3)


def test_on_a_plane_what_lies_off_it_is_tied_down_and_nothing_else_is_touched() -> None:
    rng = np.random.default_rng(9)
    belief = believed(rng.normal(size=LAYOUT.n) * 0.1, covariance(rng, LAYOUT.n))
    for kind in BOTH:
        after = kind.predict(belief, motion(PLANE, belief, 0.1), 1)
        assert definite_enough(after.P)
        assert abs(after.x[2]) < 1e-9
        assert after.P[2, 2] == pytest.approx(1e-6)
        assert after.P[0, 0] > 0.9 * belief.P[0, 0]
