"""Motion model: omnidirectional, constant acceleration and turn rate, as in robot_localization.

Over a step dt, with R = map_from_base and E the matrix from body rates to rates of roll, pitch and yaw (Diebel 2006,
"Representing attitude"; robot_localization, ekf.cpp, `predict`):

    position += R (velocity dt + acceleration dt^2 / 2)        attitude += E rate dt
    velocity += acceleration dt                                rate, acceleration, biases, scale stay
    heading reference errors, offset from the fleet's lanes *= exp(-dt / tau)
    GPS errors *= exp(-dt / tau), each with its tau; common noise, such as one sky, moves all

`acceleration` is the rate of change of `velocity`, base_link's in its own axes; the accelerometer's other terms (rate x
velocity, gravity) are the measurement's. On a plane (two_d_mode of robot_localization) states off it stay zero, with a
small variance that keeps the covariance definite.
"""

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from agents.localisation.filters.belief import Belief, Motion
from agents.localisation.filters.state import (
    ACCELERATION,
    ANGLES,
    ATTITUDE,
    OFF_PLANE,
    POSITION,
    RATE,
    SPEED,
    VELOCITY,
    YAW_RATE,
    Layout,
    Z,
)
from agents.localisation.tuning import TUNING, LocalisationTuning
from protocol.arrays import Floats

OFF_PLANE_VARIANCE = 1e-6  # of zero states on a plane, as in robot_localization
EYE = np.eye(3)
MIN_COS_PITCH = 0.05  # Euler angles are singular at +-90 deg, where a sigma point may be
OFFSET_WALK = 1e-3  # of the map's offset [m/sqrt(s)]: a map of many days stays
BESIDE_STD_M, BESIDE_S = 2.0, 300.0  # lateral offset from the fleet's lanes, and its correlation time


@dataclass(frozen=True)
class GpsError:
    """A receiver's slow error: a stationary Gauss-Markov process per axis.

    common_m2: shared with the machine's other receivers; two share the smaller value.
    """

    variance_m2: float
    time_s: float
    common_m2: float = 0.0

    def __post_init__(self) -> None:
        if not (0 < self.variance_m2 < math.inf and 0 < self.time_s < math.inf):
            raise ValueError("variance_m2 and time_s must be positive and finite")
        if not 0 <= self.common_m2 < self.variance_m2:
            raise ValueError("common_m2 must not be negative, nor as large as variance_m2")


@dataclass(frozen=True)
class HeadingError:
    """Error of a reference's absolute heading: a stationary Gauss-Markov process."""

    std_rad: float
    time_s: float


@dataclass(frozen=True)
class MotionModel:
    """What the motion depends on besides the belief.

    gps_errors: one per receiver of the layout. heading_errors: of its first references; those of anchored ones walk.
    traction: drive force over weight [-], 0 if unknown; slip_std: of wheel slip per traction. turn_error_radps:
    deviation of odometry's lasting turn-rate error, else 0. reckons: no sensor shows the place; turns_unseen: none the
    turn.
    """

    layout: Layout
    on_plane: bool = False
    gps_errors: tuple[GpsError, ...] = ()
    heading_errors: tuple[HeadingError, ...] = ()
    traction: float = 0.0
    slip_std: float = TUNING.slip_std
    turn_error_radps: float = 0.0
    reckons: bool = False
    turns_unseen: bool = False
    tuning: LocalisationTuning = TUNING

    def __post_init__(self) -> None:
        if len(self.gps_errors) != self.layout.receivers:
            raise ValueError(f"{len(self.gps_errors)} GPS errors for {self.layout.receivers} receivers")
        if len(self.heading_errors) > self.layout.references:
            raise ValueError(f"{len(self.heading_errors)} heading errors for {self.layout.references} references")

    def driven(
        self, heading_errors: tuple[HeadingError, ...], traction: float, slip_std: float, *, reckons: bool
    ) -> "MotionModel":
        """The model of another step; four times as fast as `replace`."""
        sensors = (self.layout, self.on_plane, self.gps_errors, heading_errors)
        own = (reckons, self.turns_unseen, self.tuning)
        return MotionModel(*sensors, traction, slip_std, self.turn_error_radps, *own)

    @property
    def max_step_ns(self) -> int:
        """Longest straight step: turn sensors make steps short, fixes alone do not."""
        return 250_000_000 if self.turns_unseen else sys.maxsize


def motion(model: MotionModel, belief: Belief, dt_s: float) -> Motion:
    """The motion over dt_s; attitude and velocity of the belief direct the slip noise."""
    layout, tuning = model.layout, model.tuning
    keep, walks = _constants(layout, tuning, on_plane=model.on_plane)
    scale, Q = keep.copy(), walks * dt_s
    if model.on_plane:
        Q[OFF_PLANE, OFF_PLANE] = OFF_PLANE_VARIANCE
    if model.gps_errors:
        gps = layout.gps_errors
        scale[gps], new_shares = _fading(tuple([error.time_s for error in model.gps_errors]), dt_s)
        rows = zip(_gps_covariance(model.gps_errors), new_shares, strict=True)  # lists: faster than arrays this small
        noise = [[value * share for value, share in zip(*row, strict=True)] for row in rows]
        for east_or_north in (gps.start, gps.start + 1):
            Q[east_or_north : gps.stop : 2, east_or_north : gps.stop : 2] = noise
    for state, error in enumerate(model.heading_errors, layout.heading_errors.start):
        scale[state] = math.exp(-dt_s / error.time_s)
        Q[state, state] = error.std_rad**2 * -math.expm1(-2 * dt_s / error.time_s)
    if layout.lanes:
        beside = layout.beside_lane
        scale[beside] = math.exp(-dt_s / BESIDE_S)
        Q[beside, beside] = BESIDE_STD_M**2 * -math.expm1(-2 * dt_s / BESIDE_S)
    of_position = Q[POSITION, POSITION]
    slip_mps = model.slip_std * model.traction * float(belief.x[SPEED])
    # A Gauss-Markov error of slip_s, integrated, grows by 2 std^2 time per second.
    of_position += _slip(belief.x * scale, dt_s, 2 * tuning.slip_s * slip_mps**2 * dt_s, tuning)
    if model.turn_error_radps:
        turn = layout.gyro_biases.stop - 1
        Q[turn, turn] += 2 * model.turn_error_radps**2 * dt_s / tuning.bend_s

    if model.turns_unseen:  # Gauss-Markov: no turn at rest
        bends_radps = min(tuning.curvature * abs(float(belief.x[SPEED])), tuning.max_turn_radps)
        std_radps = bends_radps + tuning.least_turn_radps
        scale[YAW_RATE] = math.exp(-dt_s / tuning.turn_s)
        Q[YAW_RATE, YAW_RATE] = std_radps**2 * -math.expm1(-2 * dt_s / tuning.turn_s)

    def f(states: Floats) -> Floats:
        return _moved(states, scale, dt_s)

    def jacobian(x: Floats) -> Floats:
        return _jacobian(x * scale, dt_s) * scale

    return Motion(f, jacobian, Q, ANGLES, model.reckons)


def gps_covariance(errors: tuple[GpsError, ...]) -> Floats:
    """Covariance (k, k) of k receivers' slow errors, per axis [m2].

    Of the common part, with correlation times t and u, 2 sqrt(t u) / (t + u) remains.
    """
    return np.array(_gps_covariance(errors))


def _gps_covariance(errors: Sequence[GpsError]) -> list[list[float]]:
    rows = [
        [min(a.common_m2, b.common_m2) * 2 * math.sqrt(a.time_s * b.time_s) / (a.time_s + b.time_s) for b in errors]
        for a in errors
    ]
    for i, error in enumerate(errors):
        rows[i][i] = error.variance_m2
    return rows


def map_from_base(attitude: Floats) -> Floats:
    """Rotation matrix (3, 3) of roll, pitch, yaw (3,) [rad]."""
    return np.array(_axes(attitude.tolist())).T


def turned_jacobian(attitude: Floats, arm: Floats) -> tuple[tuple[float, float, float], ...]:
    """Derivative (3, 3) of map_from_base(attitude) arm by roll, pitch, yaw."""
    (cr, cp, cy), (sr, sp, sy) = _trigonometry(attitude.tolist())
    forward, left, up = arm.tolist()
    left, up = cr * left - sr * up, sr * left + cr * up
    ahead, above = cp * forward + sp * up, cp * up - sp * forward
    return (
        (cy * sp * left + sy * up, cy * above, -sy * ahead - cy * left),
        (sy * sp * left - cy * up, sy * above, cy * ahead - sy * left),
        (cp * left, -ahead, 0.0),
    )


def _axes(attitude: Sequence[float]) -> tuple[tuple[float, float, float], ...]:
    """Columns of map_from_base: forward, left, up."""
    (cr, cp, cy), (sr, sp, sy) = _trigonometry(attitude)
    return (
        (cy * cp, sy * cp, -sp),
        (cy * sp * sr - sy * cr, sy * sp * sr + cy * cr, cp * sr),
        (cy * sp * cr + sy * sr, sy * sp * cr - cy * sr, cp * cr),
    )


def _trigonometry(attitude: Sequence[float]) -> tuple[tuple[float, ...], tuple[float, ...]]:
    return tuple(map(math.cos, attitude)), tuple(map(math.sin, attitude))


def _moved(states: Floats, scale: Floats, dt_s: float) -> Floats:
    """States (m, n) after a step, first scaled by (n,); angles not wrapped.

    Complex products take fewer calls than sines and cosines: a fifth faster.
    """
    rows = np.multiply(states.T, scale[:, None], order="C")  # contiguous rows of x, y, z, roll, ...
    by_roll, by_pitch, by_yaw = np.exp(1j * rows[ATTITUDE])
    velocity, half = rows[VELOCITY], rows[ACCELERATION] * (dt_s / 2)
    velocity += half
    steps = (rows[VELOCITY.start : RATE.stop] * dt_s).reshape(2, 3, -1)  # shift along the body, and turn about it
    velocity += half
    rolled = np.empty((2, len(by_roll)), complex)  # left + i up of both, as R and E begin with the roll
    rolled.real, rolled.imag = steps[:, 1], steps[:, 2]
    rolled *= by_roll
    shift, turn = rolled
    pitched = np.empty_like(shift)  # up + i ahead
    pitched.real, pitched.imag = shift.imag, steps[0, 0]
    pitched *= by_pitch
    level = np.empty_like(shift)  # east + i north
    level.real, level.imag = pitched.imag, shift.real
    level *= by_yaw
    change = np.empty((6, len(shift)))
    change[0], change[1], change[2], change[4] = level.real, level.imag, pitched.real, turn.real
    yawed = np.multiply(turn.imag, _secant(by_pitch.real), out=change[5])
    np.multiply(by_pitch.imag, yawed, out=change[3])
    change[3] += steps[1, 0]
    rows[: ATTITUDE.stop] += change
    return rows.T


def _secant(cosine: Floats) -> Floats:
    """1 / cos of the pitch, bounded near zero."""
    return cosine / np.maximum(cosine * cosine, MIN_COS_PITCH**2)


def _jacobian(x: Floats, dt_s: float) -> Floats:
    attitude = x[ATTITUDE]
    (cr, cp, _), (sr, sp, _) = _trigonometry(attitude.tolist())
    _, q, r = (x[RATE] * dt_s).tolist()
    secant = cp / max(cp * cp, MIN_COS_PITCH**2)
    turn, climb, tan = sr * q + cr * r, cr * q - sr * r, sp * secant
    F = np.eye(len(x))
    F[POSITION, ATTITUDE] = turned_jacobian(attitude, x[VELOCITY] * dt_s + x[ACCELERATION] * (dt_s**2 / 2))
    F[ATTITUDE, ATTITUDE] = (
        (1.0 + climb * tan, turn * secant**2, 0.0),
        (-turn, 1.0, 0.0),
        (climb * secant, turn * tan * secant, 1.0),
    )
    F[ATTITUDE, RATE] = (
        (dt_s, sr * tan * dt_s, cr * tan * dt_s),
        (0.0, cr * dt_s, -sr * dt_s),
        (0.0, sr * secant * dt_s, cr * secant * dt_s),
    )
    R = map_from_base(attitude)
    F[POSITION, VELOCITY] = R * dt_s
    F[POSITION, ACCELERATION] = R * (dt_s**2 / 2)
    F[VELOCITY, ACCELERATION] = EYE * dt_s
    return F


def _slip(x: Floats, dt_s: float, along_m2: float, tuning: LocalisationTuning) -> Floats:
    """Variance (3, 3) of a step's distance in map [m2]; along_m2: extra, along the body."""
    distance_m = math.hypot(*x[VELOCITY][:2].tolist()) * dt_s
    along = math.sqrt(tuning.slip_along**2 * distance_m + along_m2)
    across = tuning.slip_across * math.sqrt(distance_m)
    forward, left, _ = _axes(x[ATTITUDE].tolist())
    deviation = np.array([[along * part for part in forward], [across * part for part in left]])
    slip: Floats = deviation.T.dot(deviation)
    return slip


@lru_cache
def _fading(times_s: tuple[float, ...], dt_s: float) -> tuple[Floats, tuple[tuple[float, ...], ...]]:
    """Decay factors (2 k,) of k receivers' errors in a step, and renewed shares (k, k), exact for any step."""
    fading = -dt_s / np.array(times_s)  # logarithms
    return np.exp(fading).repeat(2), tuple(map(tuple, (-np.expm1(np.add.outer(fading, fading))).tolist()))


@lru_cache
def _constants(layout: Layout, tuning: LocalisationTuning, *, on_plane: bool) -> tuple[Floats, Floats]:
    """Factor (n,) that zeroes states off the plane, and covariance (n, n) of one second's walks."""
    keep, deviation = np.ones(layout.n), np.zeros(layout.n)
    if on_plane:
        keep[OFF_PLANE] = 0.0
    deviation[Z] = tuning.height_walk
    deviation[ATTITUDE] = tuning.tilt_walk, tuning.tilt_walk, tuning.heading_walk
    deviation[VELOCITY] = tuning.velocity_walk
    deviation[RATE] = tuning.rate_walk
    deviation[ACCELERATION] = tuning.acceleration_walk
    deviation[layout.gyro_biases] = tuning.gyro_bias_walk
    deviation[layout.wheel_scales] = tuning.wheel_scale_walk
    deviation[layout.heading_errors] = tuning.heading_walk
    deviation[layout.map_offset] = OFFSET_WALK
    walks = np.diag(deviation**2)
    for shared in (keep, walks):
        shared.setflags(write=False)
    return keep, walks
