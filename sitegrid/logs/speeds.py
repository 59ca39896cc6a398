"""A machine's speed by fixes and by wheels; a mismatch shows a wrong wheel sensor.

Both are distances over WINDOW_S: that averages the noise of fixes, and stops count in both.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from agents.clock_offsets import DRIVES_MPS
from protocol.arrays import Floats
from protocol.machine.machine_config import MachineConfig
from protocol.machine.readings import Encoder, Gps, Odometry, Reading
from protocol.site.site_config import Projection, SiteConfig

STEP_S, WINDOW_S = 0.2, 3.0
STANDS_MPS = 0.05  # for wheels


def wheel_share(fixes: tuple[Floats, Floats], wheels: tuple[Floats, Floats]) -> float:
    """Wheel distance over fix distance where both move; NaN for short logs, or if either stands.

    fixes: (n,) [s], (n, 2) [m]. wheels: stamps and distance, (m,) [s], (m,) [m].
    """
    begin, end = (max(fixes[0][0], wheels[0][0]), min(fixes[0][-1], wheels[0][-1]))
    times = np.arange(begin + WINDOW_S / 2, end - WINDOW_S / 2, STEP_S)
    if len(times) * STEP_S < 2 * WINDOW_S:
        return math.nan
    by_fixes, by_wheels = _speed(times, *fixes), _speed(times, wheels[0], wheels[1][:, None])
    moves = (by_fixes > DRIVES_MPS) & (by_wheels > STANDS_MPS)  # standstill says nothing about units
    return float(by_wheels[moves].sum() / by_fixes[moves].sum()) if moves.any() else math.nan


def places(readings: Sequence[Reading], site: SiteConfig) -> tuple[Floats, Floats]:
    """Stamps (n,) [s] and places (n, 2) in `map` [m] of fixes."""
    fixes = [reading for reading in readings if isinstance(reading, Gps)]
    degrees = np.array([(fix.lat_deg, fix.lon_deg) for fix in fixes]).reshape(-1, 2)
    return _seconds(fixes), np.stack(Projection(site).to_map_many(*degrees.T), axis=1)


def wheel_distance(readings: Sequence[Reading], machine: MachineConfig) -> tuple[Floats, Floats]:
    """Stamps (n,) [s] of one wheel sensor, and distance rolled by then (n,) [m]."""
    seconds = _seconds(readings)
    if not isinstance(readings[0], Encoder):
        speeds = np.array([r.speed_x_mps if isinstance(r, Odometry) else 0.0 for r in readings])
        return seconds, np.cumsum(np.abs(speeds) * np.diff(seconds, prepend=seconds[0]))
    sensor = machine.sensor(readings[0].sensor)
    metres = 2 * math.pi * machine.wheel_radius_m / (sensor.ticks_per_rev if sensor else 1)
    ticks = np.array([(r.left_ticks + r.right_ticks) / 2 for r in readings if isinstance(r, Encoder)])
    rolled: Floats = np.cumsum(np.abs(np.diff(ticks, prepend=ticks[0]))) * metres
    return seconds, rolled


def _seconds(readings: Sequence[Reading]) -> Floats:
    return np.array([reading.stamp_ns * 1e-9 for reading in readings])


def _speed(times: Floats, known_s: Floats, places: Floats) -> Floats:
    """Speeds (n,) [m/s] at times, over WINDOW_S around them."""
    half = WINDOW_S / 2
    ways = [np.interp(times + half, known_s, c) - np.interp(times - half, known_s, c) for c in places.T]
    speeds: Floats = np.linalg.norm(ways, axis=0) / WINDOW_S
    return speeds
