"""Drives with known errors over known ground: agents' samples at a thousandth of the cost."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mapserver.calibration.ledger import StayLedger
from protocol.arrays import Floats, Table
from protocol.machine.samples import empty

START_NS = 1_700_000_100_000_000_000
FOOT_M, TOP_M, SLOPE = 50.0, 74.0, 0.25  # ramp, along x
LATE_M = 4.0  # lag of the c_rr estimate after a change
WITHHELD_M = 2.5  # no samples around the ramp's foot and top
Site = Callable[[Floats, Floats, Floats], Floats]  # c_rr by place and heading


@dataclass(frozen=True)
class Errors:
    """One machine's zero, scale, lateral zero; from `step_s` on `step` is added to the zero."""

    zero: float = 0.0
    scale: float = 0.0
    across: float = 0.0
    step: float = 0.0
    step_s: float = np.inf


LOW = ((10.0, 10.0), (40.0, 10.0), (40.0, 40.0), (10.0, 40.0))  # closed, level
RAMP = ((20.0, 10.0), (110.0, 10.0), (110.0, 40.0), (20.0, 40.0))  # up along y = 10, down along y = 40
RAMP_AGAIN = ((26.0, 25.0), (104.0, 25.0), (104.0, 40.0), (26.0, 40.0))  # up along y = 25, down with RAMP
OPEN = ((100.0, 70.0), (900.0, 70.0))  # one way only


def height_slope(x_m: Floats) -> Floats:
    return np.where((x_m > FOOT_M) & (x_m < TOP_M), SLOPE, 0.0)


def soils(x_m: Floats, y_m: Floats, _: Floats) -> Floats:
    """Dirt, sand in the south-west, gravel in the north-east."""
    return np.where(y_m > 32.0, 0.06, np.where(x_m < 16.0, 0.25, 0.04))


def drive(
    corners: Sequence[tuple[float, float]],
    errors: Errors = Errors(),
    *,
    seconds: float = 600.0,
    site: Site = soils,
    seed: int = 0,
    direction: float = 1.0,
    speed_mps: float = 4.0,
    closed: bool = True,
    withheld: bool = True,
    late: bool = True,
    start_s: float = 0.0,
) -> Table:
    """Samples of laps. direction -1: in reverse."""
    draw = np.random.default_rng(seed)
    points = np.array([*corners, corners[0]] if closed else corners)
    lengths = np.hypot(*np.diff(points, axis=0).T)
    n = int(seconds * speed_mps / 0.5)
    driven = np.arange(n) * 0.5
    at = driven % lengths.sum()
    leg = np.minimum(np.searchsorted(np.cumsum(lengths), at, side="right"), len(lengths) - 1)
    along = (at - (np.cumsum(lengths) - lengths)[leg]) / lengths[leg]
    place = points[leg] + along[:, None] * (points[leg + 1] - points[leg])
    course = np.arctan2(*(points[leg + 1] - points[leg]).T[::-1])
    heading = course if direction > 0 else course + np.pi
    ahead = np.stack([np.cos(heading), np.sin(heading)], axis=1)
    left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
    ramp = height_slope(place[:, 0])
    slope, tilt = ramp * ahead[:, 0], ramp * left[:, 0]
    c_rr = site(place[:, 0], place[:, 1], heading)
    seconds_at = driven / speed_mps
    zero = errors.zero + errors.step * (seconds_at >= errors.step_s)
    share = direction * c_rr + slope
    wander = np.convolve(draw.normal(0.0, 0.008, n + 7), np.ones(8) / 8, "valid")
    balance = c_rr + direction * errors.scale * share
    rows = empty(n)
    rows["stamp_ns"] = START_NS + np.rint((start_s + seconds_at) * 1e9).astype(np.int64)
    rows["x_m"], rows["y_m"] = (place + _slow(n, 0.4, draw)).T
    rows["cov_xx_m2"] = rows["cov_yy_m2"] = 0.25
    rows["heading_rad"], rows["speed_mps"], rows["distance_m"] = (
        np.remainder(heading, 2 * np.pi),
        direction * speed_mps,
        0.5,
    )
    rows["c_rr"], rows["c_rr_var"] = (_late(balance) if late else balance) + direction * zero + wander, 1e-5
    measured = (slope - zero + _slow(n, 0.003, draw)[:, 0])[:, None] * ahead
    measured += (tilt + errors.across + _slow(n, 0.003, draw)[:, 0])[:, None] * left
    rows["grade_e"], rows["grade_n"] = measured.T
    rows["grade_var"] = 1e-5
    near_bend = np.minimum(np.abs(place[:, 0] - FOOT_M), np.abs(place[:, 0] - TOP_M)) < WITHHELD_M
    return rows[~near_bend] if withheld else rows


def _late(values: Floats) -> Floats:
    """Values lagging by LATE_M, like an agent's estimate."""
    kept = np.exp(-0.5 / LATE_M * 2)
    out = values.copy()
    for i in range(1, len(out)):
        out[i] = kept * out[i - 1] + (1 - kept) * values[i]
    return out


def _slow(n: int, std: float, draw: np.random.Generator) -> Floats:
    """Errors (n, 2) constant over about 30 m."""
    steps = draw.normal(0.0, std, (n // 60 + 2, 2))
    return np.stack([np.interp(np.arange(n) / 60, np.arange(len(steps)), column) for column in steps.T], axis=1)


def ledgers(rows: Mapping[str, Table]) -> dict[str, Table]:
    out = {}
    for name, table in rows.items():
        ledger = StayLedger()
        ledger.add(table)
        out[name] = ledger.stays()
    return out
