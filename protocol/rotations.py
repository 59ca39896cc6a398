"""Rotations and angles (REP-103): yaw @ pitch @ roll, pitch positive nose down, angles in [-pi, pi).

Of one attitude or arrays, axes first; quaternions are (x, y, z, w). Plain sums of products: `@` and `einsum` round
differently with the number of attitudes.
"""

import math
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike

from protocol.arrays import Floats

Angle = TypeVar("Angle", float, Floats)


def wrap_angle(angle_rad: Angle) -> Angle:
    """The angle [rad] in [-pi, pi)."""
    return (angle_rad + math.pi) % (2 * math.pi) - math.pi


def matrix_from_rpy(roll_rad: ArrayLike, pitch_rad: ArrayLike, yaw_rad: ArrayLike) -> Floats:
    """Rotation matrix (3, 3, ...) of angles (...), from the rolled frame into the fixed one."""
    cr, cp, cy = np.cos(roll_rad), np.cos(pitch_rad), np.cos(yaw_rad)
    sr, sp, sy = np.sin(roll_rad), np.sin(pitch_rad), np.sin(yaw_rad)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def rpy_from_matrix(rotation: Floats) -> Floats:
    """Roll, pitch, yaw (3, ...) [rad] of matrices (3, 3, ...)."""
    r = rotation
    pitch = np.arctan2(-r[2, 0], np.hypot(r[0, 0], r[1, 0]))
    return np.array([np.arctan2(r[2, 1], r[2, 2]), pitch, np.arctan2(r[1, 0], r[0, 0])])


def matrix_from_quaternion(quaternion: ArrayLike) -> Floats:
    """Rotation matrix (3, 3, ...) of quaternions (4, ...) of any length."""
    q = np.asarray(quaternion, np.float64)
    x, y, z, w = q / np.sqrt((q * q).sum(axis=0))
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_from_rpy(roll_rad: ArrayLike, pitch_rad: ArrayLike, yaw_rad: ArrayLike) -> Floats:
    """Unit quaternion (4, ...) of angles (...)."""
    cr, cp, cy = (np.cos(0.5 * np.asarray(angle)) for angle in (roll_rad, pitch_rad, yaw_rad))
    sr, sp, sy = (np.sin(0.5 * np.asarray(angle)) for angle in (roll_rad, pitch_rad, yaw_rad))
    return np.array(
        [
            cy * cp * sr - sy * sp * cr,
            cy * sp * cr + sy * cp * sr,
            sy * cp * cr - cy * sp * sr,
            cy * cp * cr + sy * sp * sr,
        ]
    )
