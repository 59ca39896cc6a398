"""What sensors say of the state: each reading, or the mean of several, as a `Measurement` with its model and Jacobian.

Specific force: an accelerometer on a rigid body feels dv/dt + w x v + g up, all in the body's axes, and at a lever arm
r also w x (w x r); so gravity is removed in the frame of the sensor's body, at any mounting. The lever arms of antennas
turn with roll, pitch and yaw.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from agents.localisation.belief import Measurement
from agents.localisation.kinematics import map_from_base
from agents.localisation.state import ACCELERATION, ATTITUDE, POSITION, RATE, VELOCITY, YAW_RATE
from agents.physics import GRAVITY_MPS2
from protocol.arrays import Floats

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
        at = x[:, PLACE] + _turned(x, lever_m)[:, :2]
        return at if error is None else at + x[:, error]

    def jacobian(x: Floats) -> Floats:
        H = np.zeros((2, len(x)))
        H[0, POSITION.start] = H[1, POSITION.start + 1] = 1.0
        H[:, ATTITUDE] = _turned_jacobian(x, lever_m)[:2]
        if error is not None:
            H[:, error] = np.eye(2)
        return H

    return Measurement(sensor, stamp_ns, position_m, R, h, jacobian, gate_sigma=gate, opens=PLACE)


def velocity(stamp_ns: int, sensor: str, velocity_mps: Floats, R: Floats, lever_m: Floats, gate: float) -> Measurement:
    """Velocity (2,) of an antenna in `map`: that of base_link and w x r, turned."""

    def h(x: Floats) -> Floats:
        return _turned(x, _of_antenna(x).T)[:, :2]

    def jacobian(x: Floats) -> Floats:
        H, turn = np.zeros((2, len(x))), map_from_base(x[ATTITUDE])[:2]
        H[:, ATTITUDE] = _turned_jacobian(x, _of_antenna(x))[:2]
        H[:, VELOCITY] = turn
        H[:, RATE] = -turn @ _matrix(lever_m)
        return H

    def _of_antenna(x: Floats) -> Floats:
        moving: Floats = x[..., VELOCITY] + _cross(x[..., RATE], lever_m)
        return moving

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

    def h(x: Floats) -> Floats:
        w, v = x[:, RATE], x[:, VELOCITY]
        z = np.empty((len(x), 6))
        z[:, :3] = w
        if bias is not None:
            z[:, 2] += x[:, bias]
        z[:, 3:] = x[:, ACCELERATION] + _cross(w, v) + _cross(w, _cross(w, lever_m)) + GRAVITY_MPS2 * _up(x)
        return z

    def jacobian(x: Floats) -> Floats:
        w, v = x[RATE], x[VELOCITY]
        H = np.zeros((6, len(x)))
        H[:3, RATE] = np.eye(3)
        if bias is not None:
            H[2, bias] = 1.0
        H[3:, ACCELERATION] = np.eye(3)
        H[3:, VELOCITY] = _matrix(w)
        # d/dw of w x v + w x (w x r)
        H[3:, RATE] = -_matrix(v) - _matrix(_cross(w, lever_m)) - _matrix(w) @ _matrix(lever_m)
        (sr, cr), (sp, cp) = ((np.sin(a), np.cos(a)) for a in (x[ROLL], x[PITCH]))
        H[3:, ROLL] = GRAVITY_MPS2 * np.array([0.0, cp * cr, -cp * sr])
        H[3:, PITCH] = GRAVITY_MPS2 * np.array([-cp, -sp * sr, -sp * cr])
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
        H[:, VELOCITY] = np.eye(3)
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
        H[:, ATTITUDE] = np.eye(3)
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
        H[:, RATE] = np.eye(3)
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
        H[:3, VELOCITY] = H[3:, RATE] = np.eye(3)
        return H

    return Measurement("standstill", stamp_ns, np.zeros(6), R, h, jacobian, gate_sigma=config.gate_sigma, relocks=False)


# --- rotations of many states ----------------------------------------------------------------------------------------


def _turned(x: Floats, arm: Floats) -> Floats:
    """A vector (3,), or one each (3, m), of `base_link` in `map`, for states (m, n): Rz(yaw) Ry(pitch) Rx(roll) arm."""
    (sr, sp, sy), (cr, cp, cy) = np.sin(x[:, ATTITUDE].T), np.cos(x[:, ATTITUDE].T)
    left, up = cr * arm[1] - sr * arm[2], sr * arm[1] + cr * arm[2]
    ahead, z = cp * arm[0] + sp * up, cp * up - sp * arm[0]
    return np.stack([cy * ahead - sy * left, sy * ahead + cy * left, z], axis=1)


def _turned_jacobian(x: Floats, arm: Floats) -> Floats:
    """Its derivative (3, 3) by roll, pitch and yaw at a state (n,)."""
    (sr, sp, sy), (cr, cp, cy) = np.sin(x[ATTITUDE]), np.cos(x[ATTITUDE])
    left, up = cr * arm[1] - sr * arm[2], sr * arm[1] + cr * arm[2]
    ahead, z = cp * arm[0] + sp * up, cp * up - sp * arm[0]
    by_roll = np.array([sp * left, -up, cp * left])  # d(ahead), d(left), d(z); d(up) = left, d(left) = -up
    by_pitch = np.array([z, 0.0, -ahead])
    turn = np.array([[cy, -sy, 0.0], [sy, cy, 0.0], [0.0, 0.0, 1.0]])
    by_yaw = np.array([-sy * ahead - cy * left, cy * ahead - sy * left, 0.0])
    return np.stack([turn @ by_roll, turn @ by_pitch, by_yaw], axis=1)


def _up(x: Floats) -> Floats:
    """The vertical in `base_link`, for states (m, n)."""
    (sr, cr), (sp, cp) = ((np.sin(a), np.cos(a)) for a in (x[:, ROLL], x[:, PITCH]))
    return np.stack([-sp, cp * sr, cp * cr], axis=1)


def _cross(a: Floats, b: Floats) -> Floats:
    """Cross product along the last axis; numpy's costs ten times as much on a few rows."""
    product = np.empty(np.broadcast_shapes(a.shape, b.shape))
    product[..., 0] = a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1]
    product[..., 1] = a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2]
    product[..., 2] = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return product


def _matrix(v: Floats) -> Floats:
    """[v]x, so that [v]x u is the cross product of v and u."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
