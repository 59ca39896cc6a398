"""Measurement models z = h(x) of the sensors, with Jacobians.

x: the state (`filters.state`): position p, attitude (roll, pitch, yaw), velocity v, angular rate w, acceleration a; v,
w, a in `base_link`. R = map_from_base, r: lever arm in `base_link`, [.]_en: east and north. States (m, n) come as rows;
larger models work on columns. Rates and forces arrive in `base_link`.
"""

import math

import numpy as np

from agents.localisation.filters.belief import Change, Measurement, Model
from agents.localisation.filters.motion import EYE, map_from_base, turned_jacobian
from agents.localisation.filters.state import ACCELERATION, ATTITUDE, POSITION, RATE, VELOCITY, YAW_RATE
from agents.localisation.tuning import TUNING, LocalisationTuning
from protocol.arrays import Floats
from protocol.units import GRAVITY_MPS2

STANDSTILL = "standstill"  # counter name of its measurement
ROLL, PITCH, YAW = range(ATTITUDE.start, ATTITUDE.stop)
PLACE = slice(POSITION.start, POSITION.start + 2)


def fix(
    stamp_ns: int,
    sensor: str,
    position_m: Floats,
    R: Floats,
    lever_m: Floats,
    error: slice | None,
    gate: float,
    opens: tuple[slice, ...] = (PLACE,),
    change: Change | None = None,
) -> Measurement:
    """A GPS fix (2,): z = [p + R r]_en + e; error: states of the slow error e, or None; opens: as in Measurement."""

    def h(x: Floats) -> Floats:
        columns = x.T
        at = _turned(columns, lever_m)
        at += columns[PLACE]
        if error is not None:
            at += columns[error]
        return at.T

    def jacobian(x: Floats) -> Floats:
        H = np.zeros((2, len(x)))
        H[0, POSITION.start] = H[1, POSITION.start + 1] = 1.0
        H[:, ATTITUDE] = turned_jacobian(x[ATTITUDE], lever_m)[:2]
        if error is not None:
            H[:, error] = EYE[:2, :2]
        return H

    return Measurement(sensor, stamp_ns, position_m, R, h, jacobian, gate_sigma=gate, opens=opens, change=change)


def velocity(stamp_ns: int, sensor: str, velocity_mps: Floats, R: Floats, lever_m: Floats, gate: float) -> Measurement:
    """Antenna velocity (2,) in `map`: z = [R (v + w x r)]_en."""
    by_rate = -_matrix(lever_m)  # w x r = -[r]x w

    def h(x: Floats) -> Floats:
        columns = x.T
        return _turned(columns, columns[VELOCITY] + by_rate.dot(columns[RATE])).T

    def jacobian(x: Floats) -> Floats:
        H, turn = np.zeros((2, len(x))), map_from_base(x[ATTITUDE])[:2]
        H[:, ATTITUDE] = turned_jacobian(x[ATTITUDE], x[VELOCITY] + by_rate.dot(x[RATE]))[:2]
        H[:, VELOCITY] = turn
        H[:, RATE] = turn.dot(by_rate)
        return H

    return Measurement(sensor, stamp_ns, velocity_mps, R, h, jacobian, gate_sigma=gate)


def inertial(
    stamp_ns: int, sensor: str, z: Floats, R: Floats, lever_m: Floats, bias: int | None, gate: float
) -> Measurement:
    """Angular rate and specific force (6,) of an IMU: z = (w + b e_z, f); bias: state of the yaw gyro's b, or None.

    f = a + w x (v + w x r) + g R^T e_z,    R^T e_z = (-sin pitch, cos pitch sin roll, cos pitch cos roll)
    """
    by_rate = -_matrix(lever_m)  # w x r = -[r]x w

    def h(x: Floats) -> Floats:
        columns = x.T
        w, tilt = columns[RATE], columns[ROLL:YAW]
        p, q, r = w
        ahead, left, up = columns[VELOCITY] + by_rate.dot(w)
        (sr, sp), (cr, cp) = np.sin(tilt), np.cos(tilt)
        level = GRAVITY_MPS2 * cp
        rows = np.empty((6, len(x)))
        rows[:3] = w
        if bias is not None:
            rows[2] += columns[bias]
        rows[3] = q * up - r * left - GRAVITY_MPS2 * sp
        rows[4] = r * ahead - p * up + level * sr
        rows[5] = p * left - q * ahead + level * cr
        rows[3:] += columns[ACCELERATION]
        return rows.T

    def jacobian(x: Floats) -> Floats:
        w, moving = x[RATE], x[VELOCITY] + by_rate.dot(x[RATE])
        tilt = x[ROLL:YAW].tolist()
        (sr, sp), (cr, cp) = map(math.sin, tilt), map(math.cos, tilt)
        H = np.zeros((6, len(x)))
        H[:3, RATE] = H[3:, ACCELERATION] = EYE
        if bias is not None:
            H[2, bias] = 1.0
        H[3:, VELOCITY] = across = _matrix(w)
        H[3:, RATE] = across.dot(by_rate) - _matrix(moving)  # d/dw of w x (v + w x r)
        H[3:, ROLL:YAW] = GRAVITY_MPS2 * np.array([(0.0, -cp), (cp * cr, -sp * sr), (-cp * sr, -sp * cr)])
        return H

    return Measurement(sensor, stamp_ns, z, R, h, jacobian, gate_sigma=gate)


def wheels(
    stamp_ns: int,
    sensor: str,
    velocity_mps: Floats,
    R: Floats,
    scale: int | None,
    gate: float,
    offset_m: float = 0.0,
    considers: tuple[int, ...] = (),
) -> Measurement:
    """Velocity (3,) by wheels at y left of the axle's middle: z = ((1 + s) (v_x - w_z y), v_y, v_z).

    v_y = v_z = 0. offset_m: (mean) y. scale: state of the wheel scale s, or None.
    """

    def h(x: Floats) -> Floats:
        z = x[:, VELOCITY].copy()
        z[:, 0] -= offset_m * x[:, YAW_RATE]
        if scale is not None:
            z[:, 0] *= 1 + x[:, scale]
        return z

    def jacobian(x: Floats) -> Floats:
        H = np.zeros((3, len(x)))
        H[:, VELOCITY] = EYE
        H[0, YAW_RATE] = -offset_m
        if scale is not None:
            H[0] *= 1 + x[scale]
            H[0, scale] = x[VELOCITY.start] - offset_m * x[YAW_RATE]
        return H

    return Measurement(sensor, stamp_ns, velocity_mps, R, h, jacobian, gate_sigma=gate, considers=considers)


def sides(stamp_ns: int, considers: tuple[int, ...], tuning: LocalisationTuning = TUNING) -> Measurement:
    """Without wheel readings a machine still moves along its axis: 0 = (v_y, v_z) at `base_link`."""
    states, R = slice(VELOCITY.start + 1, VELOCITY.stop), tuning.side_mps**2 * EYE[:2, :2]
    return _nothing("sides", stamp_ns, states, R, tuning.gate_sigma, considers)


def rest(stamp_ns: int, tuning: LocalisationTuning = TUNING) -> Measurement:
    """No rotation while GPS shows standstill: 0 = w; gated closely, as a machine may creep round a bend."""
    return _nothing(STANDSTILL, stamp_ns, RATE, tuning.rate_radps**2 * EYE, tuning.rest_sigma)


def turn(
    stamp_ns: int, sensor: str, rate_radps: float, std_radps: float, error: int | None, per_error: float, gate: float
) -> Measurement:
    """Turn rate (1,) about the vertical of `base_link`: z = w_z + per_error e; error: state of e, or None."""

    def h(x: Floats) -> Floats:
        rate = x[:, YAW_RATE] if error is None else x[:, YAW_RATE] + per_error * x[:, error]
        return rate[:, None]

    def jacobian(x: Floats) -> Floats:
        H = np.zeros((1, len(x)))
        H[0, YAW_RATE] = 1.0
        if error is not None:
            H[0, error] = per_error
        return H

    R = np.array([[std_radps**2]])
    return Measurement(sensor, stamp_ns, np.array([rate_radps]), R, h, jacobian, gate_sigma=gate)


def heading(
    stamp_ns: int, sensor: str, yaw_rad: float, variance: float, error: int, gate: float, change: Change | None = None
) -> Measurement:
    """Absolute heading (1,) of `base_link` in `map`: z = yaw + e; error: state of e. A relock widens e alone."""

    def h(x: Floats) -> Floats:
        return (x[:, YAW] + x[:, error])[:, None]

    def jacobian(x: Floats) -> Floats:
        H = np.zeros((1, len(x)))
        H[0, YAW] = H[0, error] = 1.0
        return H

    z, R, opens = np.array([yaw_rad]), np.array([[variance]]), (slice(error, error + 1),)
    return Measurement(sensor, stamp_ns, z, R, h, jacobian, (0,), gate_sigma=gate, opens=opens, change=change)


def orientation(
    stamp_ns: int,
    sensor: str,
    rpy_rad: Floats,
    R: Floats,
    gate: float,
    error: int | None = None,
    change: Change | None = None,
) -> Measurement:
    """Attitude (3,) of `base_link` in `map`: z = (roll, pitch, yaw + e); error: state of the anchor's e, or None."""

    def h(x: Floats) -> Floats:
        if error is None:
            return x[:, ATTITUDE]
        z = x[:, ATTITUDE].copy()
        z[:, 2] += x[:, error]
        return z

    def jacobian(x: Floats) -> Floats:
        H = np.zeros((3, len(x)))
        H[:, ATTITUDE] = EYE
        if error is not None:
            H[2, error] = 1.0
        return H

    return Measurement(sensor, stamp_ns, rpy_rad, R, h, jacobian, (0, 1, 2), gate_sigma=gate, change=change)


def rotation(stamp_ns: int, sensor: str, rates_radps: Floats, R: Floats, gate: float) -> Measurement:
    """Angular rate (3,) of `base_link`, free of bias: z = w."""
    return Measurement(sensor, stamp_ns, rates_radps, R, *_picked(RATE), gate_sigma=gate)


def standstill(stamp_ns: int, tuning: LocalisationTuning = TUNING, *, turns: bool = False) -> Measurement:
    """Zero velocity update, which shows gyro biases: 0 = (v, w); turns: 0 = v alone.

    Never relocks: an articulated machine turns its rear frame by steering, also at standstill, and a joint sensor may
    be missing.
    """
    variances, states = [tuning.still_mps**2] * 3, VELOCITY
    if not turns:
        variances, states = variances + [(0.1 * tuning.rate_radps) ** 2] * 3, slice(VELOCITY.start, RATE.stop)
    return _nothing(STANDSTILL, stamp_ns, states, np.diag(variances), tuning.gate_sigma)


def _nothing(
    sensor: str, stamp_ns: int, states: slice, R: Floats, gate: float, considers: tuple[int, ...] = ()
) -> Measurement:
    """No motion in some states: an assumption, so it never relocks."""
    h, jacobian = _picked(states)
    z = np.zeros(len(R))
    return Measurement(sensor, stamp_ns, z, R, h, jacobian, gate_sigma=gate, relocks=False, considers=considers)


def _picked(states: slice) -> tuple[Model, Model]:
    return lambda x: x[:, states], lambda x: np.eye(len(x))[states]


# --- rotations of many states ----------------------------------------------------------------------------------------


def _turned(columns: Floats, arm: Floats) -> Floats:
    """East and north (2, m) of a vector (3,) or (3, m), for states (n, m): rows of Rz(yaw) Ry(pitch) Rx(roll) arm."""
    attitude = columns[ATTITUDE]
    (sr, sp, sy), (cr, cp, cy) = np.sin(attitude), np.cos(attitude)
    ahead, left, up = arm
    ahead, left = cp * ahead + sp * (sr * left + cr * up), cr * left - sr * up
    turned = np.empty((2, columns.shape[1]))
    turned[0], turned[1] = cy * ahead - sy * left, sy * ahead + cy * left
    return turned


def _matrix(v: Floats) -> Floats:
    """[v]x: [v]x u is the cross product of v and u."""
    x, y, z = v.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
