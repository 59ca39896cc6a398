"""Positions against the truth of a simulation."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from protocol.wire.messages import Pose


def position_rmse(poses: Mapping[str, Sequence[Pose]], truth: Path) -> dict[str, float]:
    """Root mean square position error [m] of each machine; truth: the folder that a simulation wrote."""
    found = {}
    for name, track in poses.items():
        true = np.genfromtxt(truth / "tracks" / f"{name}.csv", delimiter=",", names=True)
        stamps = np.array([p.stamp_ns for p in track], np.float64)
        dx = np.interp(stamps, true["stamp_ns"], true["x"]) - [p.x_m for p in track]
        dy = np.interp(stamps, true["stamp_ns"], true["y"]) - [p.y_m for p in track]
        found[name] = math.sqrt(float((dx**2 + dy**2).mean()))
    return found
