"""What sensors say of the state: each reading, or the mean of several, as a `Measurement` with its model and Jacobian.

Specific force: an accelerometer on a rigid body feels dv/dt + w x v + g up, all in the body's axes, and at a lever arm
r also w x (w x r), together dv/dt + w x (v + w x r) + g up; so gravity is removed in the frame of the sensor's body, at
any mounting. The lever arms of antennas turn with roll, pitch and yaw.

States (m, n) come as rows; where a model takes more than a few operations it works on columns, whose values adjoin.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from agents.localisation.filters.belief import Measurement
from agents.localisation.filters.motion import EYE, map_from_base, turned_jacobian
from agents.localisation.filters.state import ACCELERATION, ATTITUDE, POSITION, RATE, VELOCITY, YAW_RATE
from protocol.arrays import Floats
from protocol.units import GRAVITY_MPS2

ROLL, PITCH, YAW = range(ATTITUDE.start, ATTITUDE.stop)
PLACE = slice(POSITION.start, POSITION.start + 2)


@dataclass(frozen=True)
class SensingConfig:
    """Standard deviations of what sensors say, where readings do not state their own, and gates.

    rate_radps, force_mps2: of an IMU, of the mean over one filter step; the force's has to cover its zero and mounting
    error, which do not average out. turn_radps: of the turn rate that odometry or steering tell where there is no IMU,
    and of its lasting error at first (per m/s for steering, whose error is one of the angle). speed_mps: of wheels;
    side_mps: how fast a machine slides aside. still_mps: of a machine at rest. gate_sigma: of all but GPS.
    min_fix_std_m: no receiver is believed to be better than this, if it says so itself. gps_gate_sigma: fixes further
    off are refused.
    """

    rate_radps: float = 0.005
    force_mps2: float = 2.0
    turn_radps: float = 0.02
    speed_mps: float = 0.04
    side_mps: float = 0.04
    still_mps: float = 0.005
    gate_sigma: float = 6.0
    min_fix_std_m: float = 0.3
    gps_gate_sigma: float = 4.0

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}: must be positive")


def fix(
    stamp_ns: int, sensor: str, position_m: Floats, R: Floats, lever_m: Floats, error: slice | None, gate: float
) -> Measurement:
    """A GPS fix (2,) in `map`; error: states of the receiver's slow error, if the filter has them."""

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

    return Measurement(sensor, stamp_ns, position_m, R, h, jacobian, gate_sigma=gate, opens=PLACE)


def velocity(stamp_ns: int, sensor: str, velocity_mps: Floats, R: Floats, lever_m: Floats, gate: float) -> Measurement:
    """Velocity (2,) of an antenna in `map`: that of base_link and w x r, turned."""
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
    stamp_ns: int,
    sensor: str,
    rates_radps: Floats,
    force_mps2: Floats,
    R: Floats,
    lever_m: Floats,
    bias: int | None,
    gate: float,
) -> Measurement:
    """Angular rate (3,) and specific force (3,) of an IMU, turned into `base_link`; bias: state of its yaw rate's."""
    by_rate = -_matrix(lever_m)  # w x r = -[r]x w

    def h(x: Floats) -> Floats:
        columns = x.T
        w, tilt = columns[RATE], columns[ROLL:YAW]
        p, q, r = w
        ahead, left, up = columns[VELOCITY] + by_rate.dot(w)
        (sr, sp), (cr, cp) = np.sin(tilt), np.cos(tilt)
        level = GRAVITY_MPS2 * cp
        z = np.empty((6, len(x)))
        z[:3] = w
        if bias is not None:
            z[2] += columns[bias]
        z[3] = q * up - r * left - GRAVITY_MPS2 * sp
        z[4] = r * ahead - p * up + level * sr
        z[5] = p * left - q * ahead + level * cr
        z[3:] += columns[ACCELERATION]
        return z.T

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

    return Measurement(sensor, stamp_ns, np.concatenate([rates_radps, force_mps2]), R, h, jacobian, gate_sigma=gate)


def wheels(stamp_ns: int, sensor: str, velocity_mps: Floats, R: Floats, scale: int | None, gate: float) -> Measurement:
    """Velocity (3,) of `base_link`: ahead as the wheels have it, aside and up; scale: state of the wheels' scale."""

    def h(x: Floats) -> Floats:
        z = x[:, VELOCITY].copy()
        if scale is not None:
            z[:, 0] *= 1 + x[:, scale]
        return z

    def jacobian(x: Floats) -> Floats:
        H = np.zeros((3, len(x)))
        H[:, VELOCITY] = EYE
        if scale is not None:
            H[0, VELOCITY.start] = 1 + x[scale]
            H[0, scale] = x[VELOCITY.start]
        return H

    return Measurement(sensor, stamp_ns, velocity_mps, R, h, jacobian, gate_sigma=gate)


def turn(
    stamp_ns: int, rate_radps: float, std_radps: float, error: int | None, per_error: float, gate: float
) -> Measurement:
    """Turn rate (1,) about the vertical of `base_link`; error: state of its lasting error, each worth per_error."""

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
    return Measurement("turn", stamp_ns, np.array([rate_radps]), R, h, jacobian, gate_sigma=gate)


def orientation(
    stamp_ns: int, sensor: str, rpy_rad: Floats, R: Floats, gate: float, error: int | None = None
) -> Measurement:
    """Roll, pitch and yaw (3,) of `base_link` in `map`; error: state of the yaw's, if the filter has one."""

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

    return Measurement(sensor, stamp_ns, rpy_rad, R, h, jacobian, angles=(0, 1, 2), gate_sigma=gate)


def rotation(stamp_ns: int, sensor: str, rates_radps: Floats, R: Floats, gate: float) -> Measurement:
    """Angular rate (3,) of `base_link`, free of bias."""

    def h(x: Floats) -> Floats:
        return x[:, RATE]

    def jacobian(x: Floats) -> Floats:
        H = np.zeros((3, len(x)))
        H[:, RATE] = EYE
        return H

    return Measurement(sensor, stamp_ns, rates_radps, R, h, jacobian, gate_sigma=gate)


def standstill(stamp_ns: int, config: SensingConfig) -> Measurement:
    """A machine at rest: no velocity and no angular rate (ZUPT), so that gyros show their bias.

    Gated, for good: wheels that stand do not keep an articulated machine from turning its rear frame as it steers.
    """
    R = np.diag([config.still_mps**2] * 3 + [(0.1 * config.rate_radps) ** 2] * 3)

    def h(x: Floats) -> Floats:
        return np.concatenate([x[:, VELOCITY], x[:, RATE]], axis=1)

    def jacobian(x: Floats) -> Floats:
        H = np.zeros((6, len(x)))
        H[:3, VELOCITY] = H[3:, RATE] = EYE
        return H

    return Measurement("standstill", stamp_ns, np.zeros(6), R, h, jacobian, gate_sigma=config.gate_sigma, relocks=False)


# --- rotations of many states ----------------------------------------------------------------------------------------


def _turned(columns: Floats, arm: Floats) -> Floats:
    """East and north (2, m) of a vector (3,), or one each (3, m), of `base_link`, for states (n, m).

    The first two rows of Rz(yaw) Ry(pitch) Rx(roll) arm.
    """
    attitude = columns[ATTITUDE]
    (sr, sp, sy), (cr, cp, cy) = np.sin(attitude), np.cos(attitude)
    ahead, left, up = arm
    ahead, left = cp * ahead + sp * (sr * left + cr * up), cr * left - sr * up
    turned = np.empty((2, columns.shape[1]))
    turned[0], turned[1] = cy * ahead - sy * left, sy * ahead + cy * left
    return turned


def _matrix(v: Floats) -> Floats:
    """[v]x, so that [v]x u is the cross product of v and u."""
    x, y, z = v.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
