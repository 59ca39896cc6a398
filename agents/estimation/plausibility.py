"""Whether a balance may be believed: why not, in a word that health and counters carry.

A machine that stands, brakes, digs or spins its wheels tells nothing of the ground's resistance, on a change of slope
its axles stand on two of them, and sensors fail: they fall silent, freeze (stuck, or at the end of their range), or
come in the wrong unit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from agents.estimation.balance import Balance
from protocol.config import require_positive
from protocol.units import GRAVITY_MPS2

# Reasons that leave the slope as it is; the others withhold the whole sample.
SLOPE_TOO = frozenset({"pitch_transient", "accelerometer"})
# Reasons that are a fault of a sensor, not of the moment.
FAULTS = frozenset({"accelerometer", "no_torque", "no_wheels", "torque_frozen", "torque_implausible"})
FORCE_NORMS_MPS2 = (5.0, 15.0)  # of a specific force in m/s2: neither in g, nor in mm/s2, nor a sensor that is dead
MEAN_S = 0.3  # over which wheels are compared with the body
MIN_C_RR = -0.08  # ground that pushes: the torque that does it is missing, and no accelerometer's zero is so far off
SMOOTH_S = 1.0  # of the forces that are compared for their unit
FORGET_S = 120.0  # of the proof that torque moves the machine


@dataclass(frozen=True)
class PlausibilityConfig:
    """Limits beyond which resistance is withheld.

    min_speed_mps: slower is a standstill. max_pitch_radps: the slope changes faster. max_brake_mps2: the wheels slow
    down faster than any resistance but sand does it. max_c_rr: ground resists less, so the bucket digs. max_slip_mps2:
    the wheels' acceleration is this far from the body's: they spin or lock. hold_s: how long after spinning,
    braking and digging the forces settle. stale_s: torque or wheel readings older than this are missing. frozen_s,
    frozen_share: torque that stays the same for so long, while the force over weight that the motion takes changes by
    so much, is stuck, or at the end of its range. max_share: drive force over weight cannot be
    more. min_gain, max_gain: drive force explains at least and at most so much of the motion.
    """

    min_speed_mps: float = 0.4
    max_pitch_radps: float = 0.026
    max_brake_mps2: float = 1.5
    max_c_rr: float = 0.45
    max_slip_mps2: float = 1.0
    hold_s: float = 0.5
    stale_s: float = 0.5
    frozen_s: float = 2.0
    frozen_share: float = 0.03
    max_share: float = 1.2
    min_gain: float = 0.4
    max_gain: float = 2.5

    def __post_init__(self) -> None:
        require_positive(self, self.__dataclass_fields__)
        if self.min_gain >= self.max_gain:
            raise ValueError("min_gain: not below max_gain")


class Plausibility:
    """Judges balances one after another."""

    def __init__(self, config: PlausibilityConfig) -> None:
        self._config = config
        self._mismatch_mps2 = 0.0  # wheels against body, low-passed
        self._hold = ("", 0.0)  # reason, and for how long still
        self._frozen = _Frozen()
        self._gain = _Gain()
        self._resisted = 0.0  # resistance, low-passed

    def judge(self, balance: Balance, resistance: float) -> str:
        """Why this balance tells nothing of the resistance; "" if it does. resistance: what it would say."""
        if not FORCE_NORMS_MPS2[0] <= balance.norm_mps2 <= FORCE_NORMS_MPS2[1]:
            return "accelerometer"
        if fault := self._fault(balance, resistance):
            return fault
        if abs(balance.speed_mps) < self._config.min_speed_mps:
            return "standstill"
        if abs(balance.pitch_radps) > self._config.max_pitch_radps:
            return "pitch_transient"
        return self._unsteady(balance, resistance)

    def _fault(self, balance: Balance, resistance: float) -> str:
        c = self._config
        if balance.wheels_s > c.stale_s:
            return "no_wheels"
        if balance.torque_s > c.stale_s:
            return "no_torque"
        drives = abs(balance.speed_mps) >= c.min_speed_mps
        if self._frozen.update(balance, drives=drives) >= c.frozen_share and self._frozen.same_s >= c.frozen_s:
            return "torque_frozen"
        if abs(balance.share) > c.max_share:
            return "torque_implausible"
        if drives:
            self._gain.update(balance)
            self._resisted += min(balance.dt_s / SMOOTH_S, 1.0) * (resistance - self._resisted)
        if self._resisted < MIN_C_RR or not c.min_gain <= self._gain.value <= c.max_gain:
            return "torque_implausible"
        return ""

    def _unsteady(self, balance: Balance, resistance: float) -> str:
        """Whether forces act, or acted a moment ago, that the balance does not know."""
        c = self._config
        off = balance.accel_mps2 - balance.body_mps2
        self._mismatch_mps2 += min(balance.dt_s / MEAN_S, 1.0) * (off - self._mismatch_mps2)
        if abs(self._mismatch_mps2) > c.max_slip_mps2:
            self._hold = "slip", c.hold_s
        elif -balance.direction * balance.accel_mps2 > c.max_brake_mps2:
            self._hold = "braking", c.hold_s
        elif resistance > c.max_c_rr:
            self._hold = "digging", c.hold_s
        reason, left_s = self._hold
        self._hold = reason, left_s - balance.dt_s
        return reason if left_s > 0 else ""


class _Frozen:
    """How long the drive force has been exactly the same, and how much what the motion takes has changed meanwhile."""

    def __init__(self) -> None:
        self.same_s = 0.0
        self._share = math.nan
        self._taken = self._low = self._high = 0.0

    def update(self, balance: Balance, *, drives: bool) -> float:
        """Take in a balance; returns the change [-]."""
        taken = balance.share - balance.unbalanced
        if not drives or balance.share != self._share:
            self.same_s, self._share = 0.0, balance.share
            self._taken = self._low = self._high = taken
            return 0.0
        self.same_s += balance.dt_s
        self._taken += min(balance.dt_s / MEAN_S, 1.0) * (taken - self._taken)
        self._low, self._high = min(self._low, self._taken), max(self._high, self._taken)
        return self._high - self._low


class _Gain:
    """How much drive force there is per force that the motion takes: slope of one on the other, 1 if units are right.

    Both vary together as the machine starts, stops and climbs; what they vary by in common is what counts, so neither
    zeros nor resistances matter. 1 until they have varied enough.
    """

    def __init__(self) -> None:
        self._weight = self._x = self._y = self._xx = self._xy = 0.0
        self._means = (0.0, 0.0)

    def update(self, balance: Balance) -> None:
        """Take in a balance of a machine that drives."""
        fade = math.exp(-balance.dt_s / FORGET_S)
        # What the motion takes, what drives, both smooth: noise of the first would make the slope look flat.
        news_xy = (balance.share - balance.unbalanced, balance.share)
        share = min(balance.dt_s / SMOOTH_S, 1.0)
        x, y = (mean + share * (new - mean) for mean, new in zip(self._means, news_xy, strict=True))
        self._means = (x, y)
        sums = (self._weight, self._x, self._y, self._xx, self._xy)
        news = (1.0, x, y, x * x, x * y)
        self._weight, self._x, self._y, self._xx, self._xy = (
            fade * old + balance.dt_s * new for old, new in zip(sums, news, strict=True)
        )

    @property
    def value(self) -> float:
        """The slope."""
        if self._weight < 20:  # seconds
            return 1.0
        x, y = self._x / self._weight, self._y / self._weight
        varied = self._xx / self._weight - x * x
        if varied < (0.3 / GRAVITY_MPS2) ** 2:
            return 1.0
        return (self._xy / self._weight - x * y) / varied
