import math
from dataclasses import replace

import numpy as np
import pytest

from agents.localisation.filters.belief import Belief
from agents.localisation.filters.motion import (
    HEIGHT_WALK,
    OFF_PLANE_VARIANCE,
    SLIP_ACROSS,
    SLIP_ALONG,
    SLIP_STD,
    SLIP_TIME_S,
    GpsError,
    MotionModel,
    gps_covariance,
    map_from_base,
    motion,
)
from agents.localisation.filters.state import (
    ACCELERATION,
    ANGLES,
    ATTITUDE,
    BASE_STATES,
    OFF_PLANE,
    POSITION,
    RATE,
    VELOCITY,
    YAW,
    Layout,
)
from protocol.arrays import Floats
from protocol.machine.machine_config import Mount

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


# --- layout ----------------------------------------------------------------------------------------------------------


def test_every_state_has_one_name() -> None:
    named = [POSITION, ATTITUDE, VELOCITY, RATE, ACCELERATION, FULL.gyro_biases, FULL.wheel_scales, FULL.gps_errors]
    states = [i for part in named for i in range(part.start, part.stop)]
    assert states == list(range(FULL.n))
    assert (FULL.gyro_bias(1), FULL.gps_error(1)) == (16, slice(20, 22))


def test_the_papers_state_has_15_components_and_nothing_behind() -> None:
    assert PAPER.n == BASE_STATES
    assert [part.stop - part.start for part in (PAPER.gyro_biases, PAPER.wheel_scales, PAPER.gps_errors)] == [0, 0, 0]
    assert tuple(range(ATTITUDE.start, ATTITUDE.stop)) == ANGLES


def test_an_error_that_the_layout_has_not_is_refused() -> None:
    for missing in (lambda: FULL.gyro_bias(2), lambda: FULL.gps_error(2), lambda: FULL.gps_error(-1)):
        with pytest.raises(IndexError):
            missing()
    with pytest.raises(ValueError, match="negative"):
        Layout(imus=-1)


# --- the motion ------------------------------------------------------------------------------------------------------


def test_constant_acceleration_is_exact_on_a_straight_line() -> None:
    x = np.zeros(15)
    x[ATTITUDE], x[VELOCITY], x[ACCELERATION] = (0.0, -0.2, 0.7), (2.0, 0.5, 0.0), (0.3, -0.1, 0.0)
    moved = driven(x, 4.0, 1)
    np.testing.assert_allclose(moved, driven(x, 4.0, 50), atol=1e-12)
    np.testing.assert_allclose(moved[POSITION], map_from_base(x[ATTITUDE]) @ (10.4, 1.2, 0.0), atol=1e-12)
    np.testing.assert_allclose(moved[VELOCITY], (3.2, 0.1, 0.0), atol=1e-12)


def test_a_constant_turn_closes_the_circle() -> None:
    x = np.zeros(15)
    x[VELOCITY.start], x[RATE.stop - 1] = 3.0, 0.3
    moved = driven(x, 2 * math.pi / 0.3, 5000)
    assert moved[YAW] == pytest.approx(2 * math.pi)
    np.testing.assert_allclose(moved[POSITION], 0.0, atol=0.02)


@pytest.mark.parametrize("pitch", [-1.0, 0.0, 0.3, 1.0])
def test_attitude_follows_the_bodys_rates(pitch: float) -> None:
    """The rotation matrix turns as dR/dt = R [rate]x, whatever the angles are."""
    x = somewhere(1, 15, pitch)
    dt = 1e-6
    before, after = (map_from_base(v[ATTITUDE]) for v in (x, driven(x, dt, 1)))
    p, q, r = x[RATE]
    np.testing.assert_allclose((after - before) / dt, before @ [[0, -r, q], [r, 0, -p], [-q, p, 0]], atol=1e-4)


def test_rotation_equals_that_of_a_mount() -> None:
    attitude = np.array([0.3, -0.7, 2.1])
    mount = Mount(rpy_deg=tuple(np.degrees(attitude).tolist()))
    np.testing.assert_allclose(map_from_base(attitude), mount.frame_from_sensor(), atol=1e-15)


@pytest.mark.parametrize("model", [SPACE, PLANE], ids=["space", "plane"])
@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("pitch", [-1.0, 0.2, 1.0])
def test_jacobian_is_that_of_finite_differences(model: MotionModel, seed: int, pitch: float) -> None:
    x = somewhere(seed, FULL.n, pitch)
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


@pytest.mark.parametrize("pitch", [math.pi / 2, -math.pi / 2, math.pi / 2 + 1e-9])
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


def test_gps_errors_fade_exactly_and_keep_their_variance() -> None:
    """Ten short steps equal a long one, and a stationary process stays as wide as it is."""
    x = np.ones(FULL.n)
    one = motion(SPACE, at(x), 5.0)
    part = motion(SPACE, at(x), 0.5)
    errors = FULL.gps_errors
    decay, short = (np.diag(m.jacobian(x))[errors] for m in (one, part))
    np.testing.assert_allclose(decay, np.exp(-5.0 / np.array([45.0, 45.0, 20.0, 20.0])))
    np.testing.assert_allclose(short**10, decay)
    variance = np.array([3.0, 3.0, 1.5, 1.5])
    for fade, Q in ((decay, one.Q), (short, part.Q)):
        np.testing.assert_allclose(fade**2 * variance + np.diag(Q)[errors], variance)


SHARED = (GpsError(3.0, 45.0, (1.0, 1.5)), GpsError(1.5, 20.0, (0.6, 0.0)))


def test_what_receivers_share_moves_both_and_lasts_as_the_covariance_says() -> None:
    """Their errors stay as wide, and as much alike, as they are; ten short steps equal a long one."""
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


def test_errors_of_equal_times_are_those_of_a_common_process_and_own_ones() -> None:
    """The same as states for common and own errors apart: their sum fades alike, and its noise is the sum of theirs."""
    share, variance_m2, dt_s = 0.8, 2.5, 3.0
    model = MotionModel(FULL, gps_errors=(GpsError(variance_m2, 45.0, (share * variance_m2,)),) * 2)
    moves = motion(model, at(np.zeros(FULL.n)), dt_s)
    added_m2 = variance_m2 * -math.expm1(-2 * dt_s / 45.0)
    sums = np.array([[1.0, 1.0, 0.0], [1.0, 0.0, 1.0]])  # common + own, of each
    parts = np.diag([share, 1 - share, 1 - share]) * added_m2
    east = FULL.gps_errors.start + np.array([0, 2])
    np.testing.assert_allclose(moves.Q[np.ix_(east, east)], sums @ parts @ sums.T, rtol=1e-12)
    np.testing.assert_array_equal(moves.Q[np.ix_(east, east + 1)], 0.0)


def test_any_parts_and_times_make_a_definite_covariance_and_noise() -> None:
    rng = np.random.default_rng(8)
    for _ in range(200):
        variances, times = 10 ** rng.uniform(-4, 2, 4), 10 ** rng.uniform(0, 3, 4)
        shares = 0.999 * rng.dirichlet((1, 1, 0.05), 4)[:, :2]
        rows = zip(variances.tolist(), times.tolist(), shares.tolist(), strict=True)
        errors = tuple(GpsError(v, t, tuple(v * part for part in parts)) for v, t, parts in rows)
        S = gps_covariance(errors)
        scale = np.sqrt(np.outer(variances, variances))
        fading = np.exp(-0.2 / times)
        for covariance in (S, S * (1 - np.outer(fading, fading))):
            assert np.linalg.eigvalsh(covariance / scale).min() > -1e-12
        np.testing.assert_array_equal(np.diag(S), variances)


@pytest.mark.parametrize("common_m2", [(-0.1,), (3.0,), (1.5, 1.5), (math.nan,)])
def test_receivers_share_no_more_than_they_err(common_m2: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="common_m2"):
        GpsError(3.0, 45.0, common_m2)


def test_at_a_standstill_nothing_slips() -> None:
    x = np.zeros(15)
    x[YAW] = 0.8
    Q = motion(PLAIN, at(x), 0.1).Q[POSITION, POSITION]
    np.testing.assert_allclose(Q, np.diag([0.0, 0.0, HEIGHT_WALK**2 * 0.1]))


def test_slip_lies_along_and_across_the_body() -> None:
    x = np.zeros(15)
    x[ATTITUDE], x[VELOCITY] = (0.1, -0.2, 2.5), (-3.0, 0.0, 0.0)
    moves = motion(replace(PLAIN, traction=0.3), at(x), 0.5)
    R = map_from_base(x[ATTITUDE])
    height = np.diag([0.0, 0.0, HEIGHT_WALK**2 * 0.5])
    wrong_slip_m2 = SLIP_STD**2 * 2 * SLIP_TIME_S * (0.3 * 3.0) ** 2 * 0.5
    along, across = SLIP_ALONG**2 * 1.5 + wrong_slip_m2, SLIP_ACROSS**2 * 1.5
    expected = np.diag([along, across, 0.0])
    np.testing.assert_allclose(R.T @ (moves.Q[POSITION, POSITION] - height) @ R, expected, atol=1e-15)


def test_noise_is_symmetric_and_not_handed_out_twice() -> None:
    x = somewhere(4, FULL.n, 0.3)
    first = motion(SPACE, at(x), 0.1).Q
    np.testing.assert_allclose(first, first.T, rtol=0, atol=1e-18)
    kept = first.copy()
    first[:] = 99.0
    np.testing.assert_array_equal(motion(SPACE, at(x), 0.1).Q, kept)


@pytest.mark.parametrize(("dt_s", "std_radps"), [(0.1, 0.02), (2.0, 0.1)])
def test_error_of_an_odometrys_turn_changes_in_a_minute(dt_s: float, std_radps: float) -> None:
    x = np.zeros(FULL.n)
    turning = motion(replace(SPACE, turn_error_radps=std_radps), at(x), dt_s)
    added = np.diag(turning.Q - motion(SPACE, at(x), dt_s).Q)
    assert np.flatnonzero(added).tolist() == [FULL.gyro_biases.stop - 1]
    assert added[FULL.gyro_biases.stop - 1] == pytest.approx(2 * std_radps**2 * dt_s / 60)


def test_errors_and_receivers_must_be_as_many() -> None:
    with pytest.raises(ValueError, match="1 GPS errors for 2 receivers"):
        MotionModel(FULL, gps_errors=ERRORS[:1])


@pytest.mark.parametrize(("variance_m2", "time_s"), [(0.0, 1.0), (1.0, 0.0), (math.nan, 1.0), (1.0, math.inf)])
def test_bad_gps_error_is_refused(variance_m2: float, time_s: float) -> None:
    with pytest.raises(ValueError, match="positive"):
        GpsError(variance_m2, time_s)
