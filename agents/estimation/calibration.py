"""Calibration of the force balance while the machine works: the accelerometer's zero and the scale of the drive force.

Over the same ground, forwards and in reverse, c_rr changes its sign in the balance and the errors do not: half the
sum of both is  zero + scale * (mean share), so flat ground shows the zero and slopes the scale (EVIDENCE, section
Ground estimation). Loaders drive so all day. Where the site names an area of known resistance, one passage tells as
much. Both enter a Kalman filter over zero and scale error; a reading that is far off, as at the border of a zone, is
left out.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import dataclass

import numpy as np

from agents.dead_reckoning import DeadReckoning
from agents.estimation.balance import Balance
from protocol.arrays import Floats
from protocol.config import require_positive

REMEMBERED = 400  # stretches: 200 m of way
RELOCK = 12  # so many that were off in a row are right, and what was known is wrong: a sensor worse than its class


@dataclass(frozen=True)
class CalibrationConfig:
    """zero, scale: standard deviations before anything is known [-]; zero_walk: of the zero [1/sqrt(s)].

    stretch_m: way that is averaged. pair_m, pair_rad: how near two passages are the same ground. pair_s: and at most so
    long apart. noise: of one stretch. floor: of the zero, and ten times as much of the scale, which no number of pairs
    gets below: the model's own error. gate_sigma: pairs further off are left out. edge_m: how far inside of a known
    area a machine has to be, with twice the standard deviation of its position.
    """

    zero: float = 0.0045
    scale: float = 0.045
    zero_walk: float = 8e-5
    stretch_m: float = 0.5
    pair_m: float = 0.7
    pair_rad: float = 0.15
    pair_s: float = 120.0
    noise: float = 0.008
    floor: float = 0.0007
    gate_sigma: float = 3.0
    edge_m: float = 3.0

    def __post_init__(self) -> None:
        require_positive(self, self.__dataclass_fields__)


@dataclass(frozen=True)
class Calibration:
    """Zero and scale error of the balance [-] with covariance (2, 2); stamp_ns: of the newest reading behind it, or 0.

    passages: how many pairs and known stretches it comes from.
    """

    zero: float
    scale: float
    covariance: tuple[tuple[float, float], tuple[float, float]]
    stamp_ns: int = 0
    passages: int = 0

    def variance(self, share: float) -> float:
        """Variance that it leaves in a balance with this drive force over weight."""
        (zz, zs), (_, ss) = self.covariance
        return zz + 2 * share * zs + share**2 * ss

    def corrected(self, balance: Balance) -> float:
        """The balance without its errors."""
        return balance.unbalanced - self.zero - self.scale * balance.share


def unknown(config: CalibrationConfig) -> Calibration:
    """Nothing known but how large errors usually are."""
    return Calibration(0.0, 0.0, ((config.zero**2, 0.0), (0.0, config.scale**2)))


@dataclass(frozen=True, slots=True)
class _Stretch:
    """Means over a stretch of way, in the frame of dead reckoning."""

    stamp_ns: int
    x_m: float
    y_m: float
    angle_rad: float
    direction: float
    unbalanced: float
    share: float


class Calibrator:
    """Finds pairs of stretches and improves a calibration by them."""

    def __init__(self, config: CalibrationConfig, known: Calibration | None = None) -> None:
        self.counters: Counter[str] = Counter()
        self._config = config
        start = known or unknown(config)
        self._x = np.array([start.zero, start.scale])
        self._P = np.array(start.covariance)
        self._stamp_ns, self._passages = start.stamp_ns, start.passages
        self._aged_ns = start.stamp_ns
        self._past: deque[_Stretch] = deque(maxlen=REMEMBERED)
        self._open: list[Balance] = []
        self._off: list[float] = []

    @property
    def calibration(self) -> Calibration:
        """What is known now."""
        (zz, zs), (_, ss) = self._P.tolist()
        least = self._config.floor
        zz, ss = max(zz, least**2), max(ss, (10 * least) ** 2)  # raised variances keep a covariance definite
        zero, scale = self._x.tolist()
        return Calibration(zero, scale, ((zz, zs), (zs, ss)), self._stamp_ns, self._passages)

    def update(self, balance: Balance, dead: DeadReckoning, known_c_rr: float | None) -> None:
        """Take in a usable balance; known_c_rr: of the ground here, where the site says it."""
        if self._open and (
            self._open[0].direction != balance.direction or balance.stamp_ns - self._open[-1].stamp_ns > 300_000_000
        ):
            self._open.clear()
        self._open.append(balance)
        if balance.way_m - self._open[0].way_m < self._config.stretch_m:
            return
        stretch = self._closed(dead)
        if known_c_rr is not None:
            cosine = math.cos(balance.slope_x)
            self._learn(stretch, stretch.unbalanced - stretch.direction * cosine * known_c_rr, stretch.share, 1.0)
            self.counters["known_ground"] += 1
        elif partner := self._partner(stretch):
            self._past.remove(partner)  # a passage counts once
            mean, share = (stretch.unbalanced + partner.unbalanced) / 2, (stretch.share + partner.share) / 2
            self._learn(stretch, mean, share, 0.5)
            self.counters["pairs"] += 1
            return
        self._past.append(stretch)

    def age(self, stamp_ns: int) -> None:
        """Let the zero drift until a stamp; it is never less known than at first."""
        if self._aged_ns:
            passed_s = max(stamp_ns - self._aged_ns, 0) * 1e-9
            aged = self._P[0, 0] + self._config.zero_walk**2 * passed_s
            self._P[0, 0] = max(min(aged, self._config.zero**2), self._P[0, 0])
        self._aged_ns = max(stamp_ns, self._aged_ns)

    def interrupt(self) -> None:
        """The stretch under way is not usable."""
        self._open.clear()

    def _closed(self, dead: DeadReckoning) -> _Stretch:
        pose, n = dead.now(), len(self._open)
        newest = self._open[-1]
        half = newest.direction * 0.5 * self._config.stretch_m  # the middle of it lies behind
        x, y = pose.x_m - half * math.cos(pose.angle_rad), pose.y_m - half * math.sin(pose.angle_rad)
        unbalanced, share = (sum(getattr(b, name) for b in self._open) / n for name in ("unbalanced", "share"))
        self._open = [newest]
        return _Stretch(newest.stamp_ns, x, y, pose.angle_rad, newest.direction, unbalanced, share)

    def _partner(self, stretch: _Stretch) -> _Stretch | None:
        """The nearest stretch of the other direction over the same ground."""
        c = self._config
        found, nearest_m = None, c.pair_m
        for other in reversed(self._past):
            if (stretch.stamp_ns - other.stamp_ns) * 1e-9 > c.pair_s:
                break
            if other.direction == stretch.direction:
                continue
            off_m = math.hypot(stretch.x_m - other.x_m, stretch.y_m - other.y_m)
            if off_m < nearest_m and abs(math.remainder(stretch.angle_rad - other.angle_rad, math.tau)) < c.pair_rad:
                found, nearest_m = other, off_m
        return found

    def _learn(self, stretch: _Stretch, measured: float, share: float, weight: float) -> None:
        """Filter measured = zero + scale * share + noise; weight: its variance in units of that of a stretch."""
        c = self._config
        self.age(stretch.stamp_ns)
        h: Floats = np.array([1.0, share])
        Ph = self._P @ h
        S = float(h @ Ph) + weight * c.noise**2
        off = measured - float(h @ self._x)
        if off**2 > c.gate_sigma**2 * S:
            self.counters["off"] += 1
            self._off.append(off)
            if len(self._off) == RELOCK:
                self._P[0, 0] += float(np.mean(np.square(self._off)))
                self._off.clear()
                self.counters["relocked"] += 1
            return
        self._off.clear()
        self._x = self._x + Ph / S * off
        self._P = self._P - np.outer(Ph, Ph) / S
        self._stamp_ns = stretch.stamp_ns
        self._passages += 1
