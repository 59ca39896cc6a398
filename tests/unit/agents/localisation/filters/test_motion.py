import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from agents.localisation.filters.belief import Belief
from agents.localisation.filters.motion import (
    OFF_PLANE_VARIANCE,
    GpsError,
    HeadingError,
    MotionModel,
    gps_covariance,
    map_from_base,
    motion,
)
from agents.localisation.filters.state import ACCELERATION, ATTITUDE, OFF_PLANE, POSITION, RATE, VELOCITY, Layout
from agents.localisation.tuning import TUNING
from protocol.arrays import Floats

PAPER, FULL = Layout(), Layout(imus=2, wheel_scale=True, receivers=2)
ERRORS = (GpsError(3.0, 45.0), GpsError(1.5, 20.0))
SPACE, PLANE = MotionModel(FULL, gps_errors=ERRORS), MotionModel(FULL, on_plane=True, gps_errors=ERRORS)
PLAIN = MotionModel(PAPER)


def at(x: Floats) -> Belief:
    return Belief(0, x, np.eye(len(x)))


def somewhere(seed: int, n: int, pitch: float) -> Floats:
    x = np.random.default_rng(seed).normal(size=n)
    x[ATTITUDE] = (0.4, pitch, 2.9)
    return x


def driven(x: Floats, seconds: float, steps: int) -> Floats:
    for _ in range(steps):
        x = motion(PLAIN, at(x), seconds / steps).f(x[None])[0]
    return x


# --- the motion ------------------------------------------------------------------------------------------------------


def test_constant_acceleration_is_exact_on_a_straight_line() -> None:
    x = np.zeros(15)
    x[ATTITUDE], x[VELOCITY], x[ACCELERATION] = (0.0, -0.2, 0.7), (2.0, 0.5, 0.0), (0.3, -0.1, 0.0)
    moved = driven(x, 4.0, 1)
    np.testing.assert_allclose(moved, driven(x, 4.0, 50), atol=1e-12)
    np.testing.assert_allclose(moved[POSITION], map_from_base(x[ATTITUDE]) @ (10.4, 1.2, 0.0), atol=1e-12)
    np.testing.assert_allclose(moved[VELOCITY], (3.2, 0.1, 0.0), atol=1e-12)


@pytest.mark.parametrize("pitch", [-1.0, 0.3])
def test_attitude_follows_the_bodys_rates(pitch: float) -> None:
    """dR/dt = R [rate]x at all angles."""
    x = somewhere(1, 15, pitch)
    dt = 1e-6
    before, after = (map_from_base(v[ATTITUDE]) for v in (x, driven(x, dt, 1)))
    p, q, r = x[RATE]
    np.testing.assert_allclose((after - before) / dt, before @ [[0, -r, q], [r, 0, -p], [-q, p, 0]], atol=1e-4)


@pytest.mark.parametrize("model", [SPACE, PLANE], ids=["space", "plane"])
@pytest.mark.parametrize("pitch", [-1.0, 0.2])
def test_jacobian_is_that_of_finite_differences(model: MotionModel, pitch: float) -> None:
    x = somewhere(1, FULL.n, pitch)
    moves = motion(model, at(x), 0.1)
    h = 1e-6
    numeric = (moves.f(x + h * np.eye(FULL.n)) - moves.f(x - h * np.eye(FULL.n))).T / (2 * h)
    np.testing.assert_allclose(moves.jacobian(x), numeric, atol=1e-8)


def test_many_states_move_as_each_alone() -> None:
    states = np.random.default_rng(5).normal(size=(7, FULL.n))
    before = states.copy()
    moves = motion(SPACE, at(states[0]), 0.05)
    np.testing.assert_allclose(moves.f(states), [moves.f(state[None])[0] for state in states], rtol=0, atol=1e-14)
    np.testing.assert_array_equal(states, before)


@pytest.mark.parametrize("pitch", [math.pi / 2, -math.pi / 2])
def test_straight_up_is_survived(pitch: float) -> None:
    x = somewhere(1, 15, pitch)
    moves = motion(PLAIN, at(x), 0.01)
    assert np.abs(moves.f(x[None])).max() < 10
    assert np.isfinite(moves.jacobian(x)).all()


def test_on_a_plane_nothing_leaves_it() -> None:
    x = somewhere(2, FULL.n, 0.5)
    moves = motion(PLANE, at(x), 0.1)
    assert not moves.f(x[None])[0, OFF_PLANE].any()
    F = moves.jacobian(x)
    assert not F[OFF_PLANE].any()
    assert not F[:, OFF_PLANE].any()
    assert (np.diag(moves.Q)[OFF_PLANE] == OFF_PLANE_VARIANCE).all()
    x[OFF_PLANE] = 0.0
    np.testing.assert_allclose(moves.f(x[None])[0], motion(SPACE, at(x), 0.1).f(x[None])[0], atol=1e-15)


# --- noise -----------------------------------------------------------------------------------------------------------


SHARED = (GpsError(3.0, 45.0, 2.5), GpsError(1.5, 20.0, 0.6))


def test_what_receivers_share_moves_both_and_lasts_as_the_covariance_says() -> None:
    """Variances and correlation are stationary; ten short steps equal a long one."""
    x, errors = np.ones(FULL.n), FULL.gps_errors
    S = np.kron(gps_covariance(SHARED), np.eye(2))
    long, short = (motion(MotionModel(FULL, gps_errors=SHARED), at(x), dt_s) for dt_s in (5.0, 0.5))
    for moves in (long, short):
        F = moves.jacobian(x)[errors, errors]
        np.testing.assert_allclose(F @ S @ F.T + moves.Q[errors, errors], S, atol=1e-12)
    F, P = short.jacobian(x)[errors, errors], np.zeros((4, 4))
    for _ in range(10):
        P = F @ P @ F.T + short.Q[errors, errors]
    np.testing.assert_allclose(P, long.Q[errors, errors], atol=1e-12)
    assert S[0, 2] == pytest.approx(0.6 * 2 * math.sqrt(45 * 20) / (45 + 20))


def test_slip_lies_along_and_across_the_body() -> None:
    x = np.zeros(15)
    x[ATTITUDE], x[VELOCITY] = (0.1, -0.2, 2.5), (-3.0, 0.0, 0.0)
    moves = motion(replace(PLAIN, traction=0.3), at(x), 0.5)
    R = map_from_base(x[ATTITUDE])
    height = np.diag([0.0, 0.0, TUNING.height_walk**2 * 0.5])
    wrong_slip_m2 = TUNING.slip_std**2 * 2 * TUNING.slip_s * (0.3 * 3.0) ** 2 * 0.5
    along, across = TUNING.slip_along**2 * 1.5 + wrong_slip_m2, TUNING.slip_across**2 * 1.5
    expected = np.diag([along, across, 0.0])
    np.testing.assert_allclose(R.T @ (moves.Q[POSITION, POSITION] - height) @ R, expected, atol=1e-15)


@pytest.mark.parametrize(
    ("make", "problem"),
    [
        (lambda: GpsError(0.0, 1.0), "positive"),
        (lambda: GpsError(1.0, 0.0), "positive"),
        (lambda: GpsError(math.nan, 1.0), "positive"),
        (lambda: GpsError(1.0, math.inf), "positive"),
        (lambda: GpsError(3.0, 45.0, -0.1), "common_m2"),
        (lambda: GpsError(3.0, 45.0, 3.0), "common_m2"),  # shared variance above the whole
        (lambda: GpsError(3.0, 45.0, math.nan), "common_m2"),
        (lambda: MotionModel(FULL, gps_errors=ERRORS[:1]), "1 GPS errors for 2 receivers"),
        (lambda: MotionModel(PAPER, heading_errors=(HeadingError(0.05, 100.0),)), "1 heading errors for 0 references"),
        (lambda: Layout(imus=-1), "negative"),
        (lambda: FULL.gyro_bias(2), "no IMU 2 among 2"),
        (lambda: FULL.gps_error(-1), "no receiver -1 among 2"),
    ],
)
def test_what_makes_no_model_is_refused(make: Callable[[], object], problem: str) -> None:
    with pytest.raises((ValueError, IndexError), match=problem):
        make()
