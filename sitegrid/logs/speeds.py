"""How fast a machine was by its fixes and by its wheels: where they disagree, a clock or a wheel sensor is wrong.

Both speeds are the distance over WINDOW_S, so that the noise of fixes averages out and stops count in both.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from protocol.arrays import Floats
from protocol.machine.machine_config import MachineConfig
from protocol.machine.readings import Encoder, Gps, Odometry, Reading
from protocol.site.site_config import Projection, SiteConfig

STEP_S, WINDOW_S = 0.2, 3.0
MAX_LAG_S = 60.0  # a larger offset between two clocks is looked for by their first and last stamps
SURE, GAIN = 0.5, 0.05  # least correlation of the best lag, and by how much it must exceed that of lag 0
STANDS_MPS, DRIVES_MPS = 0.05, 0.7  # wheels that stand; fixes that move by more than their noise


@dataclass(frozen=True)
class Agreement:
    """How wheels compare with fixes.

    lag_s: by how much the stamps of the fixes are ahead of those of the wheels, None where the drive does not show it.
    wheel_share: distance by the wheels over distance by the fixes, NaN where either stands.
    """

    lag_s: float | None
    wheel_share: float


def compare_speeds(fixes: tuple[Floats, Floats], wheels: tuple[Floats, Floats]) -> Agreement | None:
    """Compare fixes (n,) [s], (n, 2) [m] with the distance of the wheels (m,) [s], (m,) [m]; None of a short log."""
    begin, end = (max(fixes[0][0], wheels[0][0]), min(fixes[0][-1], wheels[0][-1]))
    times = np.arange(begin + WINDOW_S / 2, end - WINDOW_S / 2, STEP_S)
    if len(times) * STEP_S < 2 * WINDOW_S:
        return None
    by_fixes, by_wheels = _speed(times, *fixes), _speed(times, wheels[0], wheels[1][:, None])
    moves = (by_fixes > DRIVES_MPS) & (by_wheels > STANDS_MPS)  # those that stand say nothing of their unit
    share = float(by_wheels[moves].sum() / by_fixes[moves].sum()) if moves.any() else math.nan
    return Agreement(_lag_s(_capped(by_fixes), _capped(by_wheels)), share)


def places(readings: Sequence[Reading], site: SiteConfig) -> tuple[Floats, Floats]:
    """Stamps (n,) [s] and places (n, 2) in `map` [m] of the fixes among readings."""
    fixes = [reading for reading in readings if isinstance(reading, Gps)]
    degrees = np.array([(fix.lat_deg, fix.lon_deg) for fix in fixes]).reshape(-1, 2)
    return _seconds(fixes), np.stack(Projection(site).to_map_many(*degrees.T), axis=1)


def wheel_distance(readings: Sequence[Reading], machine: MachineConfig) -> tuple[Floats, Floats]:
    """Stamps (n,) [s] of wheel readings of one sensor, and how far the wheels had rolled by then (n,) [m]."""
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
    """Speeds (n,) [m/s] at times, by the way over WINDOW_S around them."""
    half = WINDOW_S / 2
    ways = [np.interp(times + half, known_s, c) - np.interp(times - half, known_s, c) for c in places.T]
    speeds: Floats = np.linalg.norm(ways, axis=0) / WINDOW_S
    return speeds


def _capped(speeds: Floats) -> Floats:
    """Without peaks, which a jump of fixes makes."""
    return np.minimum(speeds, np.percentile(speeds, 95))


def _lag_s(fixes: Floats, wheels: Floats) -> float | None:
    """The lag of two speeds that correlates best, 0 where that is hardly better than none; None where none does.

    It is looked for up to half of the time that both have; one at the end of that is none.
    """
    most = min(round(MAX_LAG_S / STEP_S), len(fixes) // 2)
    lags = range(-most, most + 1)
    correlations = np.array(
        [_correlation(fixes[max(k, 0) : len(fixes) + min(k, 0)], wheels[max(-k, 0) :]) for k in lags]
    )
    best = int(correlations.argmax())
    if correlations[best] < SURE or best in (0, len(lags) - 1):
        return None
    return float(lags[best] * STEP_S) if correlations[best] > correlations[most] + GAIN else 0.0


def _correlation(a: Floats, b: Floats) -> float:
    a, b = a - a.mean(), b[: len(a)] - b[: len(a)].mean()
    size = math.sqrt(float(a @ a) * float(b @ b))
    return float(a @ b) / size if size else 0.0
