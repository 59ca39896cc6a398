"""ROS messages to values of readings. Pure. Axes by REP 103, covariances by REP 145."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from protocol.machine.machine_config import SensorConfig

Values = tuple[float, ...]
TICKS_PER_RAD = SensorConfig.ticks_per_rev / math.tau  # wheel angles in possibly fractional ticks
NOT_MEASURED = -1.0  # first element of an unknown covariance
JOINT_STATE = "sensor_msgs/msg/JointState"
MOST_JOINTS = {"encoder": 2, "articulation": 1, "steering": 1}


def _fix(message: Any, _: Sequence[str]) -> Values:
    if message.status.status < 0:
        raise ValueError("no fix")
    variances = message.position_covariance[[0, 4, 8]] if message.position_covariance_type else (0.0,) * 3
    height_m = message.altitude if math.isfinite(message.altitude) else 0.0
    return message.latitude, message.longitude, height_m, *map(_variance, variances)


def _imu(message: Any, _: Sequence[str]) -> Values:
    parts = {"rate": message.angular_velocity, "force": message.linear_acceleration}
    measured = measures(message) or (*parts,)
    return tuple(v for q, a in parts.items() for v in ((a.x, a.y, a.z) if q in measured else (0.0,) * 3))


def measures(message: Any) -> tuple[str, ...]:
    """`measures` of an Imu; empty: all, and for other messages."""
    covariances = {"rate": "angular_velocity_covariance", "force": "linear_acceleration_covariance"}
    known = [q for q, name in covariances.items() if getattr(message, name, (0.0,))[0] != NOT_MEASURED]
    return () if len(known) == len(covariances) else tuple(known)


def _attitude(message: Any, _: Sequence[str]) -> Values:
    q, covariance = message.orientation, message.orientation_covariance
    if covariance[0] == NOT_MEASURED or not 0.9 < math.hypot(q.x, q.y, q.z, q.w) < 1.1:
        raise ValueError("no orientation")
    return q.x, q.y, q.z, q.w, *map(_variance, covariance[[0, 4, 8]])


def _odometry(message: Any, _: Sequence[str]) -> Values:
    twist, _covariance = _twist(message)
    return twist.linear.x, twist.linear.y, twist.angular.z


def _velocity(message: Any, _: Sequence[str]) -> Values:
    twist, covariance = _twist(message)
    return twist.linear.x, twist.linear.y, _variance(covariance[0]), _variance(covariance[7])


def _twist(message: Any) -> tuple[Any, Sequence[float]]:
    """Velocity and covariance (36,), 0 if the type has none."""
    covariance: Sequence[float] = (0.0,) * 36
    while hasattr(message, "twist"):
        covariance, message = getattr(message, "covariance", covariance), message.twist
    return message, covariance


def _variance(value: float) -> float:
    """0 for unknown: NaN and negative values too."""
    return float(value) if value > 0 else 0.0


def _joints(quantity: str, made: Callable[[list[float]], Values]) -> Callable[[Any, Sequence[str]], Values]:
    def values(state: Any, names: Sequence[str]) -> Values:
        known = dict(zip(state.name, getattr(state, quantity), strict=False))
        if missing := [name for name in names if name not in known]:
            raise ValueError(f"no {quantity} of {missing[0]}")
        return made([float(known[name]) for name in names])

    return values


_Takes = dict[str, tuple[str, Callable[[Any, Sequence[str]], Values]]]
_ANGLE = ("position of one joint [rad]", _joints("position", lambda angles: (angles[0],)))
_TWIST: _Takes = {
    "odometry": ("twist linear.x, linear.y [m/s], angular.z [rad/s]", _odometry),
    "gps_velocity": ("twist linear.x east, linear.y north [m/s], covariance [m2/s2]", _velocity),
}
_TICKS = _joints("position", lambda angles: (angles[0] * TICKS_PER_RAD, angles[-1] * TICKS_PER_RAD))
# By type and kind: fields, and conversion of a message and chosen joints; ValueError: no reading.
TYPES: dict[str, _Takes] = {
    "sensor_msgs/msg/NavSatFix": {"gps": ("latitude, longitude [deg], altitude [m], position_covariance [m2]", _fix)},
    "sensor_msgs/msg/Imu": {
        "imu": ("angular_velocity [rad/s], linear_acceleration [m/s2]", _imu),
        "attitude": ("orientation, orientation_covariance [rad2]", _attitude),
    },
    "nav_msgs/msg/Odometry": {"odometry": _TWIST["odometry"]},
    "geometry_msgs/msg/TwistStamped": _TWIST,
    "geometry_msgs/msg/TwistWithCovarianceStamped": _TWIST,
    "geometry_msgs/msg/TwistWithCovariance": _TWIST,
    JOINT_STATE: {
        "encoder": ("position of left and right wheel [rad]", _TICKS),
        "articulation": _ANGLE,
        "steering": _ANGLE,
        "torque": ("effort [Nm], summed", _joints("effort", lambda efforts: (sum(efforts),))),
    },
}
SURE = {"sensor_msgs/msg/NavSatFix": "gps", "sensor_msgs/msg/Imu": "imu"}
