import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

from agents.localisation.filters.belief import Belief, Filter, Measurement, Motion
from agents.localisation.filters.ekf import Ekf
from agents.localisation.filters.motion import GpsError, MotionModel, map_from_base, motion
from agents.localisation.filters.state import ATTITUDE, PITCH, RATE, ROLL, VELOCITY, YAW, Layout
from agents.localisation.filters.ukf import SigmaPoints, Ukf
from protocol.arrays import Floats

STEPS = 1500
PAPER_UKF, SMALL_UKF = Ukf(alpha=1.0, beta=2.0), Ukf(alpha=1e-3, beta=2.0, kappa=0.0)
BOTH = [Ekf(), Ukf()]
ALL = [*BOTH, PAPER_UKF, SMALL_UKF]
LAYOUT = Layout(imus=1, wheel_scale=True, receivers=2)
MODEL = MotionModel(LAYOUT, gps_errors=(GpsError(3.0, 45.0), GpsError(1.5, 20.0)))
PLANE = replace(MODEL, on_plane=True)
ANGLES_OF = {1: (0,), 4: (0, 1)}  # of the long-run sensors
LEVER_M = np.array([0.8, 0.3, 3.0])


def name(value: Any) -> str | None:
    return f"{type(value).__name__}-{value.alpha}" if isinstance(value, Ukf) else None


def frozen(values: Any) -> Floats:
    """Read-only array: filters must not change inputs."""
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
    """GPS fix (east, north) with lever arm and receiver error: nonlinear in attitude."""
    error = LAYOUT.gps_error(receiver)
    h = 1e-6

    def fix(states: Floats) -> Floats:
        arms = np.array([map_from_base(attitude) @ LEVER_M for attitude in states[:, ATTITUDE]])
        return states[:, :2] + arms[:, :2] + states[:, error]

    def slopes(x: Floats) -> Floats:
        return (fix(x + h * np.eye(len(x))) - fix(x - h * np.eye(len(x)))).T / (2 * h)

    return Measurement(f"gps-{receiver}", 0, frozen(z), frozen(R), fix, slopes, **options)


def pick(states: Any, z: Any, R: Any, **options: Any) -> Measurement:
    """Direct measurement of some states."""
    return linear(z, np.eye(LAYOUT.n)[states], R, **options)


def definite_enough(P: Floats) -> bool:
    """Positive definite in any units: scaled to a unit diagonal."""
    scale = np.sqrt(np.diag(P))
    return bool(np.linalg.eigvalsh(P / np.outer(scale, scale))[0] > 0)


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


def small(scale: float) -> tuple[Belief, Motion, list[Measurement]]:
    """Belief, motion and measurements with standard deviations and innovations of this scale."""
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


# --- the unscented transform -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [Ukf(), PAPER_UKF, Ukf(alpha=0.5, beta=2.0, kappa=0.0)], ids=name)
def test_its_steps_are_filterpys(kind: Ukf) -> None:
    """filterpy's sums are well conditioned here; motion and measurement are nonlinear."""
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
        ({"kappa": -2.0}, "kappa"),  # too small for two states
    ],
)
def test_bad_option_is_refused_by_name(options: dict[str, float], named: str) -> None:
    with pytest.raises(ValueError, match=named):
        Ukf(**options).condition(believed(np.zeros(2), np.eye(2)), linear([0.0], [[1.0, 0.0]], [[1.0]]))


def test_the_least_kappa_leaves_a_spread() -> None:
    assert SigmaPoints(2, 1, alpha=1.0, beta=2.0, kappa=-1.75).gamma == 0.5


# --- refusals --------------------------------------------------------------------------------------------------------

BAD = [
    ([1.0, math.nan], np.eye(2)),
    ([1.0, -math.inf], np.eye(2)),
    ([1.0, 2.0], [[1.0, 0.0], [math.nan, 1.0]]),
    ([1.0, 2.0], [[1.0, math.nan], [0.0, 1.0]]),
    ([1.0, 2.0], [[math.inf, 0.0], [0.0, 1.0]]),
    ([1.0, 2.0], [[1.0, 0.0], [0.0, 0.0]]),
    ([1.0, 2.0], [[-1.0, 0.0], [0.0, 1.0]]),
    ([1.0, 2.0], [[1.0, 2.0], [2.0, 1.0]]),
]


@pytest.mark.parametrize("kind", BOTH, ids=name)
@pytest.mark.parametrize(("z", "R"), BAD)
def test_a_bad_measurement_leaves_the_belief_unchanged(kind: Filter, z: Any, R: Any) -> None:
    belief = believed(np.zeros(3), np.eye(3))
    conditioned = kind.condition(belief, linear(z, np.eye(3)[:2], R))
    assert not conditioned.accepted
    assert conditioned.belief is belief
    assert math.isnan(conditioned.nis)
    assert (conditioned.innovation.shape, conditioned.innovation_covariance.shape) == ((2,), (2, 2))


@pytest.mark.parametrize("kind", BOTH, ids=name)
def test_the_gate_counts_in_standard_deviations_of_the_innovation(kind: Filter) -> None:
    """State and measurement of variance 1: 3 sigma are 4.24."""
    belief = believed(np.zeros(3), np.eye(3))
    near, far = ([4.2], [4.3])
    assert kind.condition(belief, linear(near, np.eye(3)[:1], [[1.0]], gate_sigma=3.0)).accepted
    gated = kind.condition(belief, linear(far, np.eye(3)[:1], [[1.0]], gate_sigma=3.0))
    assert not gated.accepted
    assert gated.belief is belief
    assert gated.nis == pytest.approx(4.3**2 / 2)
    assert kind.condition(belief, linear([1e6], np.eye(3)[:1], [[1.0]])).accepted


# --- the covariance --------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("kind", BOTH, ids=name)
@pytest.mark.parametrize("model", [MODEL, PLANE], ids=["space", "plane"])
def test_covariance_stays_symmetric_and_definite_through_dropouts_and_extremes(
    kind: Filter, model: MotionModel
) -> None:
    """Long dropouts; covariances of 1e-10 to 1e10."""
    seed = 7
    rng = np.random.default_rng(seed)
    start = believed(np.zeros(LAYOUT.n), np.diag(10.0 ** rng.uniform(-6, 4, LAYOUT.n)))
    belief, heard, moves = start, np.ones(5, dtype=bool), motion(model, start, 0.1)
    accepted = 0
    for step in range(STEPS):
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
    assert accepted > STEPS // 5


def _any_measurement(sensor: int, rng: np.random.Generator, belief: Belief) -> Measurement:
    variance = 10.0 ** rng.uniform(-10, 10) if rng.random() < 0.1 else 10.0 ** rng.uniform(-4, 1)
    states = ([0, 1], [YAW], range(*RATE.indices(15)), range(*VELOCITY.indices(15)), [ROLL, PITCH])
    picked = list(states[sensor])
    z = rng.normal(size=len(picked)) * (10.0 if sensor == 0 else 0.3)
    R = np.eye(len(picked)) * variance
    return antenna(0, z, R, gate_sigma=6.0) if sensor == 0 else pick(picked, z, R, angles=ANGLES_OF.get(sensor, ()))


@pytest.mark.parametrize("kind", BOTH, ids=name)
def test_no_angle_is_less_known_than_to_a_right_angle(kind: Filter) -> None:
    """A day without data; the rest stays finite."""
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


def test_on_a_plane_what_lies_off_it_is_tied_down_and_nothing_else_is_touched() -> None:
    rng = np.random.default_rng(9)
    belief = believed(rng.normal(size=LAYOUT.n) * 0.1, covariance(rng, LAYOUT.n))
    for kind in BOTH:
        after = kind.predict(belief, motion(PLANE, belief, 0.1), 1)
        assert definite_enough(after.P)
        assert abs(after.x[2]) < 1e-9
        assert after.P[2, 2] == pytest.approx(1e-6)
        assert after.P[0, 0] > 0.9 * belief.P[0, 0]
