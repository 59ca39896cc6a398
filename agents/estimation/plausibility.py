"""Whether a balance may be believed; if not, the reason in a word that health and counters carry.

A machine that stands, brakes, digs or spins its wheels shows nothing of the ground's resistance; on a change of slope
its axles stand on two slopes; and sensors fail: they fall silent, freeze (stuck, or at the end of their range), or come
in the wrong unit.

Brakes that neither the torque sensor nor a reading shows make the ground seem rough: downhill at constant speed, without
torque, c_rr would be just the grade. So a machine that rolls without torque shows nothing, unless its brakes are read,
or its torque has braked before: then that sees them.
"""

import math

from agents.estimation.balance import SLOW_MPS, Balance
from protocol.units import GRAVITY_MPS2

# Reasons that make the slope worthless too: such a sample says that the machine was there, and how heavy.
SLOPE_TOO = frozenset({"pitch_transient", "accelerometer"})
# Reasons that are a fault of a sensor, not of the moment.
FAULTS = frozenset({"accelerometer", "no_torque", "no_wheels", "torque_frozen", "torque_implausible"})
# Norm of a specific force in m/s2. One in g or in mm/s2 is outside, and so is a broken sensor.
FORCE_NORMS_MPS2 = (5.0, 15.0)
STALE_S = 0.5  # torque or wheel readings older than this are missing
MIN_SPEED_MPS = 0.4  # slower is a standstill
# The pitch rate over the speed is the change of slope per metre: with more than this, the axles stand on slopes that
# differ by 2 to 3 degrees.
MAX_CURVE_RADPM = 0.013
MAX_BRAKE_MPS2 = 1.5  # the wheels slow down faster than by any resistance but that of sand
# Of drive force over weight, in the direction of travel: who pulls more does not brake, but sand or a ramp slows it
# down. Above noise and zero of the torque of one that coasts, and no more than gravel resists.
PULLS_SHARE = 0.02
APPLIED = 0.01  # of a brake: less is its play
# Drive force over weight in the direction of travel: below the first, the machine rolls without torque, but for noise
# and zero; below the second the torque brakes it, as no engine's own drag does.
ROLLS_SHARE, BRAKES_SHARE = 0.015, -0.06
MAX_C_RR = 0.45  # no ground that a machine drives on resists more: the bucket digs
MIN_C_RR = -0.08  # the ground pushes: the torque that does it is missing, and no accelerometer's zero is so far off
MAX_SLIP_MPS2 = 1.0  # the wheels' acceleration is this far from the body's: they spin or lock
MEAN_S = 0.3  # over which wheels and body are compared
HOLD_S = 0.5  # forces settle for so long after slip, braking and digging
# Torque that stays exactly the same for so long, while the force that the motion takes changes by this share of the
# weight, is stuck or at the end of its range.
FROZEN_S, FROZEN_SHARE = 2.0, 0.03
MAX_SHARE = 1.2  # of drive force over weight: no tyre drives with much more than its load
# Drive force per force that the motion takes: 1 if units are right; a scale error of sensors is far smaller.
MIN_GAIN, MAX_GAIN = 0.4, 2.5
PUSHES = -0.03  # c_rr by a balance that no zero of a sensor explains, nor a jolt: the ground seems to push
SMOOTH_S = 1.0  # over which the two are smoothed before they are compared
FORGET_S = 120.0  # how long their comparison is remembered
LEAST_COMPARED_S = 20.0
LEAST_VARIED = 0.3 / GRAVITY_MPS2  # standard deviation of the force that the motion takes, over weight


class Plausibility:
    """Judges balances one after another."""

    def __init__(self) -> None:
        self._mismatch_mps2 = 0.0  # wheels against body, low-passed
        self._hold = ("", 0.0)  # reason, and for how long still
        self._frozen = _Frozen()
        self._gain = _Gain()
        self._resisted = 0.0  # resistance, low-passed
        self._braked = 0.0  # drive force over weight in the direction of travel, low-passed
        self._torque_brakes = False  # whether the torque was seen to brake

    def judge(self, balance: Balance, resistance: float) -> str:
        """Why this balance shows nothing of the resistance; "" if it does. resistance: c_rr by this balance."""
        if not FORCE_NORMS_MPS2[0] <= balance.norm_mps2 <= FORCE_NORMS_MPS2[1]:
            return "accelerometer"
        if fault := self._fault(balance, resistance):
            return fault
        if abs(balance.speed_mps) < MIN_SPEED_MPS:
            return "standstill"
        if abs(balance.pitch_radps) > MAX_CURVE_RADPM * max(abs(balance.speed_mps), SLOW_MPS):
            return "pitch_transient"
        return self._unsteady(balance, resistance)

    def _fault(self, balance: Balance, resistance: float) -> str:
        if balance.wheels_s > STALE_S:
            return "no_wheels"
        if balance.torque_s > STALE_S:
            return "no_torque"
        drives = abs(balance.speed_mps) >= MIN_SPEED_MPS
        if self._frozen.update(balance, drives=drives) >= FROZEN_SHARE and self._frozen.same_s >= FROZEN_S:
            return "torque_frozen"
        if abs(balance.share) > MAX_SHARE:
            return "torque_implausible"
        if drives:
            self._gain.update(balance)
            self._resisted += min(balance.dt_s / SMOOTH_S, 1.0) * (resistance - self._resisted)
        return "torque_implausible" if self._resisted < MIN_C_RR or self._gain.is_wrong else ""

    def _unsteady(self, balance: Balance, resistance: float) -> str:
        """Whether forces that the balance does not include act, or acted a moment ago."""
        may_brake = self._may_brake_unseen(balance)
        difference = balance.accel_mps2 - balance.body_mps2
        self._mismatch_mps2 += min(balance.dt_s / MEAN_S, 1.0) * (difference - self._mismatch_mps2)
        if abs(self._mismatch_mps2) > MAX_SLIP_MPS2:
            self._hold = "slip", HOLD_S
        elif _brakes(balance):
            self._hold = "braking", HOLD_S
        elif may_brake:
            self._hold = "braking_unseen", HOLD_S
        elif resistance > MAX_C_RR:
            self._hold = "digging", HOLD_S
        reason, left_s = self._hold
        self._hold = reason, left_s - balance.dt_s
        return reason if left_s > 0 else ""


    def _may_brake_unseen(self, balance: Balance) -> bool:
        """Whether the machine rolls without torque, and nothing has shown its brakes."""
        pulls = balance.direction * balance.share
        self._braked += min(balance.dt_s / SMOOTH_S, 1.0) * (pulls - self._braked)
        self._torque_brakes |= self._braked < BRAKES_SHARE
        return not self._torque_brakes and math.isnan(balance.brake) and pulls < ROLLS_SHARE


def _brakes(balance: Balance) -> bool:
    """Whether a brake is applied, or the machine slows down fast, not because the ground does it while it pulls."""
    slows_mps2 = -balance.direction * balance.accel_mps2
    return balance.brake > APPLIED or (
        slows_mps2 > MAX_BRAKE_MPS2 and balance.direction * balance.share < PULLS_SHARE
    )


class _Frozen:
    """How long the drive force has been exactly the same, and how much the motion's force has changed meanwhile."""

    def __init__(self) -> None:
        self.same_s = 0.0
        self._share = math.nan
        self._motion = self._low = self._high = 0.0

    def update(self, balance: Balance, *, drives: bool) -> float:
        """Add a balance; returns the change [-]."""
        motion = balance.share - balance.unbalanced
        if not drives or balance.share != self._share:
            self.same_s, self._share = 0.0, balance.share
            self._motion = self._low = self._high = motion
            return 0.0
        self.same_s += balance.dt_s
        self._motion += min(balance.dt_s / MEAN_S, 1.0) * (motion - self._motion)
        self._low, self._high = min(self._low, self._motion), max(self._high, self._motion)
        return self._high - self._low


class _Gain:
    """Drive force per force that the motion takes: slope of a regression of one on the other, 1 if units are right.

    Both vary together as the machine starts, stops and climbs. Only their common variation counts, so neither zeros nor
    resistances that stay the same matter. 1 until they have varied enough.

    Resistance that varies with the motion does matter: sand takes force and slows the machine down, so that more force
    comes with less acceleration, as if the sign were wrong. But sand resists all the time. With a wrong gain k, c_rr by
    a balance is k c_rr plus (k - 1) times the motion's force, which falls below 0 as the machine climbs or slows down.
    So a gain is wrong only if the ground seems to have pushed as well.
    """

    def __init__(self) -> None:
        self._weight = self._x = self._y = self._xx = self._xy = 0.0
        self._means = (0.0, 0.0)
        self._least = 0.0  # c_rr of late

    def update(self, balance: Balance) -> None:
        """Add a balance of a machine that drives."""
        fade = math.exp(-balance.dt_s / FORGET_S)
        # The force of the motion and the drive force, both smooth: noise of the first would make the slope look flat.
        news_xy = (balance.share - balance.unbalanced, balance.share)
        share = min(balance.dt_s / SMOOTH_S, 1.0)
        x, y = (mean + share * (new - mean) for mean, new in zip(self._means, news_xy, strict=True))
        self._means = (x, y)
        self._least = min(fade * self._least, balance.direction * (y - x))
        sums = (self._weight, self._x, self._y, self._xx, self._xy)
        news = (1.0, x, y, x * x, x * y)
        self._weight, self._x, self._y, self._xx, self._xy = (
            fade * old + balance.dt_s * new for old, new in zip(sums, news, strict=True)
        )

    @property
    def is_wrong(self) -> bool:
        """Whether no scale error of a sensor explains it, nor the ground."""
        return self._least < PUSHES and not MIN_GAIN <= self._value <= MAX_GAIN

    @property
    def _value(self) -> float:
        """The slope [-]."""
        if self._weight < LEAST_COMPARED_S:
            return 1.0
        x, y = self._x / self._weight, self._y / self._weight
        varied = self._xx / self._weight - x * x
        if varied < LEAST_VARIED**2:
            return 1.0
        return (self._xy / self._weight - x * y) / varied
