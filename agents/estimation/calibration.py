"""Calibration of the force balance at work: accelerometer bias and scale of the drive force.

Forwards and in reverse over the same ground, c_rr changes sign in the balance; errors do not:

    (unbalanced_1 + unbalanced_2) / 2 = bias + scale (share_1 + share_2) / 2

Flat ground shows the bias, slopes the scale. On ground of known resistance one passage is enough; closed loops show the
bias (`closed_tours`). A Kalman filter combines them; outliers, as at a zone's border, are excluded.
"""

import math
from collections import Counter, deque
from dataclasses import dataclass

import numpy as np

from agents.dead_reckoning import DeadReckoning
from agents.estimation.balance import MAX_GAP_NS, Balance
from agents.estimation.closed_tours import Tour
from agents.estimation.offers import intersected
from agents.estimation.tuning import TUNING, EstimationTuning
from protocol.arrays import Floats
from protocol.machine.samples import APPLIED, LIMITS, SCALE_STD, ZERO_STD, ZERO_WALK
from protocol.wire.messages import CalibrationOffer

KEPT = 400  # stretches: 200 m
MOST_ZERO, MOST_SCALE = (LIMITS[name][1] for name in APPLIED)  # largest that a sample may state
EDGE_M = 3.0  # distance inside known ground, plus two standard deviations


@dataclass(frozen=True)
class Calibration:
    """Bias and scale error [-] with covariance (2, 2); stamp_ns: newest reading used, or 0.

    passages: pairs, known stretches and loops used. offer_ns: stamp of the last offer used, or 0.
    """

    zero: float
    scale: float
    covariance: tuple[tuple[float, float], tuple[float, float]]
    stamp_ns: int = 0
    passages: int = 0
    offer_ns: int = 0

    def variance(self, share: float) -> float:
        """Variance it leaves in a balance of this share."""
        (zz, zs), (_, ss) = self.covariance
        return zz + 2 * share * zs + share**2 * ss

    def corrected(self, balance: Balance) -> float:
        """The calibrated balance."""
        return balance.unbalanced - self.zero - self.scale * balance.share


UNCALIBRATED = Calibration(0.0, 0.0, ((ZERO_STD**2, 0.0), (0.0, SCALE_STD**2)))


@dataclass(frozen=True, slots=True)
class _Stretch:
    """Means, in the frame of dead reckoning."""

    stamp_ns: int
    x_m: float
    y_m: float
    angle_rad: float
    direction: float
    unbalanced: float
    share: float


class Calibrator:
    """Pairs stretches, and improves a calibration by them."""

    def __init__(self, calibration: Calibration | None = None, tuning: EstimationTuning = TUNING) -> None:
        """Start, perhaps with an earlier `calibration`."""
        start, self._tuning = calibration or UNCALIBRATED, tuning
        self.counters: Counter[str] = Counter()
        self._x = np.array([start.zero, start.scale])
        self._P = np.array(start.covariance)
        self._stamp_ns, self._passages = start.stamp_ns, start.passages
        self._aged_ns, self._offer_ns = start.stamp_ns, start.offer_ns
        self._past: deque[_Stretch] = deque(maxlen=KEPT)
        self._stretch: list[Balance] = []
        # innovations of loops and others since the last accepted one
        self._excluded: dict[bool, list[float]] = {True: [], False: []}

    @property
    def calibration(self) -> Calibration:
        """The current one."""
        (zz, zs), (_, ss) = self._P.tolist()
        zz, ss = (
            max(zz, self._tuning.floor**2),
            max(ss, (10 * self._tuning.floor) ** 2),
        )  # keep it definite
        zero, scale = np.clip(self._x, (-MOST_ZERO, -MOST_SCALE), (MOST_ZERO, MOST_SCALE)).tolist()
        return Calibration(zero, scale, ((zz, zs), (zs, ss)), self._stamp_ns, self._passages, self._offer_ns)

    def update(
        self, balance: Balance, dead_reckoning: DeadReckoning, known_c_rr: float | None, shaking_var: float = 0.0
    ) -> None:
        """Add a usable balance. known_c_rr: of the ground here; shaking_var: of one balance, beyond the usual [-]."""
        newest = self._stretch[-1] if self._stretch else balance
        if newest.direction != balance.direction or balance.stamp_ns - newest.stamp_ns > MAX_GAP_NS:
            self._stretch.clear()
        self._stretch.append(balance)
        if balance.distance_m - self._stretch[0].distance_m < self._tuning.stretch_m:
            return
        # A body that shakes goes nowhere; what the powertrain leaves open stays the same over a stretch.
        variance = self._tuning.stretch_std**2 + shaking_var / len(self._stretch) ** 2 + balance.share_var
        stretch = self._end_stretch(dead_reckoning)
        if known_c_rr is not None:
            cosine = math.cos(balance.slope_x)
            measured = stretch.unbalanced - stretch.direction * cosine * known_c_rr
            self._learn(stretch.stamp_ns, measured, stretch.share, variance)
            self.counters["known_ground"] += 1
        elif partner := self._partner(stretch):
            self._past.remove(partner)  # a passage counts once
            mean, share = (stretch.unbalanced + partner.unbalanced) / 2, (stretch.share + partner.share) / 2
            self._learn(stretch.stamp_ns, mean, share, variance / 2)
            self.counters["pairs"] += 1
            return
        self._past.append(stretch)

    def add_tour(self, tour: Tour) -> None:
        """Add a closed loop."""
        self._learn(tour.stamp_ns, tour.zero, 0.0, tour.std**2, is_tour=True)
        self.counters["tours"] += 1

    def take(self, offer: CalibrationOffer, now_ns: int) -> None:
        """Fuse an offer that does not contradict the own estimate; both have the same variance floor."""
        self.age(now_ns)
        passed_s = max(now_ns - offer.stamp_ns, 0) * 1e-9
        offered: Floats = np.array([offer.zero, offer.scale])
        zz = max(offer.zero_var, self._tuning.floor**2) + ZERO_WALK**2 * passed_s
        B: Floats = np.array(
            [[zz, offer.covariance], [offer.covariance, max(offer.scale_var, (10 * self._tuning.floor) ** 2)]]
        )
        off = offered - self._x
        if float(off @ np.linalg.solve(self._P + B, off)) > self._tuning.gate_offer_sigma**2:
            self.counters["refused_offer_off"] += 1
            return
        self._x, self._P = intersected(self._x, self._P, offered, B)
        self._offer_ns, self._stamp_ns = offer.stamp_ns, max(self._stamp_ns, offer.stamp_ns)
        self.counters["offers"] += 1

    def age(self, stamp_ns: int) -> None:
        """Let the bias drift, up to its initial variance."""
        if self._aged_ns:
            passed_s = max(stamp_ns - self._aged_ns, 0) * 1e-9
            aged = self._P[0, 0] + ZERO_WALK**2 * passed_s
            self._P[0, 0] = max(min(aged, ZERO_STD**2), self._P[0, 0])
        self._aged_ns = max(stamp_ns, self._aged_ns)

    def interrupt(self) -> None:
        """Drop the current stretch."""
        self._stretch.clear()

    def _end_stretch(self, dead_reckoning: DeadReckoning) -> _Stretch:
        pose, n = dead_reckoning.pose, len(self._stretch)
        newest = self._stretch[-1]
        half = newest.direction * 0.5 * self._tuning.stretch_m
        x, y = pose.x_m - half * math.cos(pose.angle_rad), pose.y_m - half * math.sin(pose.angle_rad)
        unbalanced, share = (sum(getattr(b, name) for b in self._stretch) / n for name in ("unbalanced", "share"))
        self._stretch = [newest]
        return _Stretch(newest.stamp_ns, x, y, pose.angle_rad, newest.direction, unbalanced, share)

    def _partner(self, stretch: _Stretch) -> _Stretch | None:
        partner, nearest_m = None, self._tuning.pair_m
        for other in reversed(self._past):
            if (stretch.stamp_ns - other.stamp_ns) * 1e-9 > self._tuning.pair_s:
                break
            if other.direction == stretch.direction:
                continue
            distance_m = math.hypot(stretch.x_m - other.x_m, stretch.y_m - other.y_m)
            if distance_m >= nearest_m:
                continue
            if abs(math.remainder(stretch.angle_rad - other.angle_rad, math.tau)) < self._tuning.pair_rad:
                partner, nearest_m = other, distance_m
        return partner

    def _learn(self, stamp_ns: int, measured: float, share: float, variance: float, *, is_tour: bool = False) -> None:
        """Filter measured = bias + scale * share + noise."""
        self.age(stamp_ns)
        h: Floats = np.array([1.0, share])
        Ph = self._P @ h
        S = float(h @ Ph) + variance
        innovation = measured - float(h @ self._x)
        if innovation**2 > self._tuning.gate_sigma**2 * S:
            self.counters["off"] += 1
            excluded = self._excluded[is_tour]
            excluded.append(innovation)
            if len(excluded) < (self._tuning.relock_tours if is_tour else self._tuning.relock):
                return
            self._P[0, 0] += float(np.mean(np.square(excluded)))
            self.counters["relocked"] += 1
        else:
            self._x = self._x + Ph / S * innovation
            self._P = self._P - np.outer(Ph, Ph) / S
            self._stamp_ns = stamp_ns
            self._passages += 1
        for excluded in self._excluded.values():
            excluded.clear()
