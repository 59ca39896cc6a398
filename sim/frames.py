"""Rotations between `map` and `base_link` for arrays of machines (REP-103: pitch is positive nose down)."""

from __future__ import annotations

import numpy as np

from protocol.arrays import Floats


def map_from_base(vector: Floats, yaw_rad: Floats, pitch_rad: Floats, roll_rad: Floats) -> Floats:
    """Rotate one vector (3,) of `base_link` into `map` for all attitudes (k,): returns (k, 3)."""
    cy, sy, cp, sp = np.cos(yaw_rad), np.sin(yaw_rad), np.cos(pitch_rad), np.sin(pitch_rad)
    cr, sr = np.cos(roll_rad), np.sin(roll_rad)
    x, y, z = vector
    ahead = cp * x + sp * sr * y + sp * cr * z
    left = cr * y - sr * z
    return np.stack([cy * ahead - sy * left, sy * ahead + cy * left, -sp * x + cp * sr * y + cp * cr * z], axis=-1)


def body_rates(yaw_rate: Floats, pitch_rate: Floats, roll_rate: Floats, pitch_rad: Floats, roll_rad: Floats) -> Floats:
    """Angular rate in `base_link` (n, 3) from the rates of yaw, pitch and roll (n,)."""
    cp, sp, cr, sr = np.cos(pitch_rad), np.sin(pitch_rad), np.cos(roll_rad), np.sin(roll_rad)
    about_y = pitch_rate * cr + yaw_rate * sr * cp
    about_z = yaw_rate * cr * cp - pitch_rate * sr
    return np.stack([roll_rate - yaw_rate * sp, about_y, about_z], axis=-1)


def up_in_base(pitch_rad: Floats, roll_rad: Floats) -> Floats:
    """The vertical (n, 3) as `base_link` sees it."""
    cp = np.cos(pitch_rad)
    return np.stack([-np.sin(pitch_rad), cp * np.sin(roll_rad), cp * np.cos(roll_rad)], axis=-1)
