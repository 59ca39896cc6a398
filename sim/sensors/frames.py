"""Vector and quaternion (x, y, z, w) algebra for arrays of machines, axes first: (3, ...), (4, ...).

Plain sums: `@` and `einsum` round differently with the number of machines, so seeds would not repeat.
"""

from __future__ import annotations

import numpy as np

from protocol.arrays import Floats


def map_from_base(vector: Floats, yaw_rad: Floats, pitch_rad: Floats, roll_rad: Floats) -> Floats:
    """Rotate vectors (3, ...) from `base_link` into `map`, for attitudes (...)."""
    cy, sy, cp, sp = np.cos(yaw_rad), np.sin(yaw_rad), np.cos(pitch_rad), np.sin(pitch_rad)
    cr, sr = np.cos(roll_rad), np.sin(roll_rad)
    x, y, z = vector
    ahead = cp * x + sp * sr * y + sp * cr * z
    left = cr * y - sr * z
    return np.stack([cy * ahead - sy * left, sy * ahead + cy * left, -sp * x + cp * sr * y + cp * cr * z])


def cross(a: Floats, b: Floats) -> Floats:
    """Cross product of vectors (3, ...)."""
    (ax, ay, az), (bx, by, bz) = a, b
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def turned(matrix: Floats, vector: Floats) -> Floats:
    """Rotate vectors (3, r, units) by one matrix per unit (3, 3, units)."""
    x, y, z = matrix[:, :, None].swapaxes(0, 1)
    product: Floats = x * vector[0] + y * vector[1] + z * vector[2]
    return product


def seen_turned(angle_rad: Floats, vector: Floats) -> Floats:
    """Vectors (3, ...) in a frame turned by an angle (...) about z."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    x, y, z = vector
    return np.stack([c * x + s * y, c * y - s * x, z])


def rotation(vector_rad: Floats) -> Floats:
    """Matrix (3, 3) of a rotation vector (3,) (Rodrigues)."""
    x, y, z = vector_rad
    angle = float(np.hypot(np.hypot(x, y), z))
    along = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    half = np.sinc(angle / (2 * np.pi))  # numpy's sinc(x) is sin(pi x) / (pi x)
    turn: Floats = np.eye(3) + np.sinc(angle / np.pi) * along + 0.5 * half**2 * (along @ along)
    return turn


def compose(first: Floats, second: Floats) -> Floats:
    """Hamilton product of quaternions (4, ...): `map_from_a`, `a_from_b` give `map_from_b`."""
    (ax, ay, az, aw), (bx, by, bz, bw) = first, second
    x = aw * bx + ax * bw + ay * bz - az * by
    y = aw * by - ax * bz + ay * bw + az * bx
    z = aw * bz + ax * by - ay * bx + az * bw
    return np.stack([x, y, z, aw * bw - ax * bx - ay * by - az * bz])
