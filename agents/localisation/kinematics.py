"""How the machine moves: omnidirectional, with constant acceleration and turn rate, as in robot_localization.

Over a step dt, with R = map_from_base and E the matrix from body rates to the rates of roll, pitch and yaw
(Diebel 2006, "Representing attitude"; robot_localization, ekf.cpp, `predict`):

    position += R (velocity dt + acceleration dt^2 / 2)        attitude += E rate dt
    velocity += acceleration dt                                rate, acceleration, biases, scale stay
    GPS error *= exp(-dt / tau)

`velocity` is that of base_link's origin in its own axes and `acceleration` its rate of change; what an accelerometer
feels besides (rate x velocity, gravity) belongs to the measurement. On a plane (`two_d`) the states off the plane are
zero before and after each step, with a small variance of their own so that the covariance stays definite.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from agents.localisation.belief import Belief, Motion
from agents.localisation.state import (
    ACCELERATION,
    ATTITUDE,
    OFF_PLANE,
    POSITION,
    RATE,
    VELOCITY,
    Layout,
    Z,
)
from protocol.arrays import Floats

OFF_PLANE_VARIANCE = 1e-6  # of states that are zero on a plane, as robot_localization measures them
EYE = np.eye(3)
MIN_COS_PITCH = 0.05  # Euler angles are singular at +-90 deg; no machine drives there, but a sigma point may


@dataclass(frozen=True)
class MotionConfig:
    """What the model does not know, as noise.

    slip_along, slip_across: standard deviation of the way driven along and across the body, over the square root of
    the way [m/sqrt(m)]: none at a standstill. The others are random walks: height_walk [m/sqrt(s)]; tilt_walk (roll
    and pitch), heading_walk [rad/sqrt(s)]; velocity_walk [m/s/sqrt(s)]; rate_walk [rad/s/sqrt(s)];
    acceleration_walk [m/s2/sqrt(s)]; gyro_bias_walk [rad/s/sqrt(s)]; wheel_scale_walk [1/sqrt(s)].
    two_d: the machine moves on a plane.
    """

    two_d: bool = False
    slip_along: float = 0.02
    slip_across: float = 0.03
    height_walk: float = 0.02
    tilt_walk: float = 5e-3
    heading_walk: float = 1e-3
    velocity_walk: float = 0.05
    rate_walk: float = 0.3
    acceleration_walk: float = 1.0
    gyro_bias_walk: float = 5e-5
    wheel_scale_walk: float = 2e-4

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            if name != "two_d" and not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name}: must be positive and finite")


@dataclass(frozen=True)
class GpsError:
    """A receiver's slow error: a stationary Gauss-Markov process per axis, of that variance and correlation time."""

    variance_m2: float
    time_s: float

    def __post_init__(self) -> None:
        if not (0 < self.variance_m2 < math.inf and 0 < self.time_s < math.inf):
            raise ValueError("variance_m2 and time_s must be positive and finite")


def motion(
    layout: Layout,
    config: MotionConfig,
    belief: Belief,
    dt_s: float,
    gps_errors: Sequence[GpsError] = (),
    slip_m2: float = 0.0,
) -> Motion:
    """The motion over dt_s from a belief, whose attitude and velocity direct the slip noise.

    gps_errors: one per receiver of the layout. slip_m2: variance that slip adds along the body in this step, on top
    of slip_along, where it is known better than that, e.g. from the drive torque.
    """
    if len(gps_errors) != layout.receivers:
        raise ValueError(f"{len(gps_errors)} GPS errors for {layout.receivers} receivers")
    keep, walks = _constants(layout, config)
    scale, Q = keep.copy(), np.diag(walks * dt_s)
    if config.two_d:
        Q[OFF_PLANE, OFF_PLANE] = OFF_PLANE_VARIANCE
    for i, error in enumerate(gps_errors):
        states = layout.gps_error(i)
        scale[states] = math.exp(-dt_s / error.time_s)
        # exact for steps of any length: what fades is renewed, so that the variance stays
        Q[states, states] = EYE[:2, :2] * (error.variance_m2 * -math.expm1(-2 * dt_s / error.time_s))
    Q[POSITION, POSITION] += _slip(belief.x * scale, config, dt_s, slip_m2)

    def f(states: Floats) -> Floats:
        return _moved(states, scale, dt_s)

    def jacobian(x: Floats) -> Floats:
        return _jacobian(x * scale, dt_s) * scale

    return Motion(f, jacobian, Q, layout.angles)


def map_from_base(attitude: Floats) -> Floats:
    """Rotation matrix (3, 3) of roll, pitch, yaw (3,) [rad]."""
    (cr, cp, cy), (sr, sp, sy) = _trigonometry(attitude)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def _trigonometry(attitude: Floats) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Cosines and sines of roll, pitch and yaw."""
    angles = attitude.tolist()
    return tuple(map(math.cos, angles)), tuple(map(math.sin, angles))


def _moved(states: Floats, scale: Floats, dt_s: float) -> Floats:
    """States (m, n) after a step, multiplied by scale (n,) before; angles are not wrapped."""
    rows = np.multiply(states.T, scale[:, None], order="C")  # a row each of x, y, z, roll, ...: their values adjoin
    (sr, sp, sy), (cr, cp, cy) = np.sin(rows[ATTITUDE]), np.cos(rows[ATTITUDE])
    change = rows[ACCELERATION] * dt_s
    steps = (rows[VELOCITY.start : RATE.stop] * dt_s).reshape(2, 3, -1)  # the way along the body, the turn about it
    steps[0] += change * (dt_s / 2)
    (forward, turn), to_left, upward = steps.transpose(1, 0, 2)
    left, pitched = cr * to_left - sr * upward  # R and E both begin with the roll
    up, yawed = sr * to_left + cr * upward
    ahead = cp * forward + sp * up
    yawed /= np.copysign(np.maximum(np.abs(cp), MIN_COS_PITCH), cp)
    rows[0] += cy * ahead - sy * left
    rows[1] += sy * ahead + cy * left
    rows[2] += cp * up - sp * forward
    rows[3] += turn + sp * yawed
    rows[4] += pitched
    rows[5] += yawed
    rows[VELOCITY] += change
    return rows.T


def _jacobian(x: Floats, dt_s: float) -> Floats:
    """Derivative (n, n) of `_moved` at a state (n,)."""
    (cr, cp, cy), (sr, sp, sy) = _trigonometry(x[ATTITUDE])
    forward, left, up = (x[VELOCITY] * dt_s + x[ACCELERATION] * (dt_s**2 / 2)).tolist()
    left, up = cr * left - sr * up, sr * left + cr * up
    ahead, above = cp * forward + sp * up, cp * up - sp * forward
    _, q, r = (x[RATE] * dt_s).tolist()
    safe = math.copysign(max(abs(cp), MIN_COS_PITCH), cp)
    turn, climb, tan = sr * q + cr * r, cr * q - sr * r, sp / safe
    F = np.eye(len(x))
    R = map_from_base(x[ATTITUDE])
    F[POSITION, ATTITUDE] = (
        (cy * sp * left + sy * up, cy * above, -sy * ahead - cy * left),
        (sy * sp * left - cy * up, sy * above, cy * ahead - sy * left),
        (cp * left, -ahead, 0.0),
    )
    F[POSITION, VELOCITY] = R * dt_s
    F[POSITION, ACCELERATION] = R * (dt_s**2 / 2)
    F[ATTITUDE, ATTITUDE] += (
        (climb * tan, turn / safe**2, 0.0),
        (-turn, 0.0, 0.0),
        (climb / safe, turn * tan / safe, 0.0),
    )
    F[ATTITUDE, RATE] = (
        (dt_s, sr * tan * dt_s, cr * tan * dt_s),
        (0.0, cr * dt_s, -sr * dt_s),
        (0.0, sr / safe * dt_s, cr / safe * dt_s),
    )
    F[VELOCITY, ACCELERATION] = EYE * dt_s
    return F


def _slip(x: Floats, config: MotionConfig, dt_s: float, slip_m2: float) -> Floats:
    """Variance (3, 3) in map of the way driven in a step [m2]."""
    way_m = math.hypot(*x[VELOCITY][:2].tolist()) * dt_s
    along, across = math.sqrt(config.slip_along**2 * way_m + slip_m2), config.slip_across * math.sqrt(way_m)
    deviation = map_from_base(x[ATTITUDE]) * (along, across, 0.0)
    return deviation @ deviation.T


@lru_cache
def _constants(layout: Layout, config: MotionConfig) -> tuple[Floats, Floats]:
    """Factor (n,) that sets the states off the plane to zero, and variances (n,) of the random walks in a second."""
    keep, deviation = np.ones(layout.n), np.zeros(layout.n)
    if config.two_d:
        keep[OFF_PLANE] = 0.0
    deviation[Z] = config.height_walk
    deviation[ATTITUDE] = config.tilt_walk, config.tilt_walk, config.heading_walk
    deviation[VELOCITY] = config.velocity_walk
    deviation[RATE] = config.rate_walk
    deviation[ACCELERATION] = config.acceleration_walk
    deviation[layout.gyro_biases] = config.gyro_bias_walk
    deviation[layout.wheel_scales] = config.wheel_scale_walk
    variance = deviation**2
    for shared in (keep, variance):
        shared.setflags(write=False)
    return keep, variance
