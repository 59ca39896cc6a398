"""Whether a balance may be believed; if not, the reason in a word that health and counters carry.

A machine that stands, brakes, digs, spins its wheels or slips in its driveline shows nothing of the ground's
resistance; on a change of slope its axles stand on two slopes; and sensors fail: they fall silent, freeze (stuck, or at
the end of their range), or come in the wrong unit.

Brakes that neither the torque sensor nor a reading shows make the ground seem rough: downhill at constant speed and
without torque, c_rr would be just the grade. So a machine that rolls without torque on ground that seems rougher than
where it pulled shows nothing, unless its brakes are read, or its torque has braked before: then that sees them.
"""

import math

from agents.estimation.balance import SLOW_MPS, Balance
from agents.estimation.shaking import Shaking
from protocol.units import GRAVITY_MPS2

# Reasons that make the slope worthless too: such a sample says that the machine was there, and how heavy.
SLOPE_TOO = frozenset({"pitch_transient", "accelerometer"})
# Reasons that are a fault of a sensor, not of the moment.
FAULTS = frozenset({"accelerometer", "no_torque", "no_wheels", "torque_frozen", "torque_implausible"})
# Norm of a specific force in m/s2. One in g or in mm/s2 is outside, and so is a broken sensor.
FORCE_NORMS_MPS2 = (5.0, 15.0)
STALE_S = 0.5  # torque or wheel readings older than this are missing
# Wheels certainly roll, and in this direction, if their speed is so many times its standard deviation: 0.15 m/s by an
# encoder of 100 ticks on a wheel of 0.75 m, at 20 Hz. Slower than the second number they roll into the ground's play.
ROLLS_SIGMA, MIN_SPEED_MPS = 3.0, 0.05
# The pitch rate over the speed is the change of slope per metre. At the first limit the axles of a loader stand on
# slopes that differ by the second, 2.5 degrees; a shorter machine may bend its way by more. Where a machine shakes, the
# rate is the mean over the way from axle to axle.
MAX_CURVE_RADPM, MAX_DIFFERENCE_RAD = 0.013, 0.0429
# What a step may shake by, ahead and in pitch, before limits widen. A loader on tyres has 0.15 m/s2 and 0.002 rad/s,
# 0.013 rad/s at the foot of a ramp. The second is half the rate that is too much.
USUAL_MPS2, USUAL_RADPS = 0.25, 0.013
AXLES_M = 3.3  # the way from axle to axle where the wheelbase is not known: a loader's
AXLES_S = (0.5, 1.0)  # limits of the time that the way takes: a gyro's bias turns the slope of who creeps
MAX_BRAKE_MPS2 = 1.5  # the wheels slow down faster than by any resistance but that of sand
# Of drive force over weight, in the direction of travel: who pulls more does not brake, but sand or a ramp slows it
# down. Above noise and zero of the torque of one that coasts, and no more than gravel resists.
PULLS_SHARE = 0.02
APPLIED = 0.01  # of a brake: less is its play
# Drive force over weight in the direction of travel: below the first, the machine rolls without torque, but for noise
# and zero; below the second the torque brakes it, as no engine's own drag does.
ROLLS_SHARE, BRAKES_SHARE = 0.015, -0.06
ROUGHER = 0.02  # c_rr as it rolls, above that of before: more than noise and zero make of it
MAX_C_RR = 0.45  # no ground that a machine drives on resists more: the bucket digs
MIN_C_RR = -0.08  # the ground pushes: the torque that does it is missing, and no accelerometer's zero is so far off
MAX_SLIP_MPS2 = 1.0  # the wheels' acceleration is this far from the body's: they spin or lock
MEAN_S = 0.3  # over which wheels and body are compared
HOLD_S = 0.5  # forces settle for so long after slip, braking, digging and a turn of a machine that skids
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
    """Judges balances one after another. axles_m: the wheelbase, 0 where it is not known."""

    def __init__(self, axles_m: float = 0.0) -> None:
        self._axles_m = axles_m or AXLES_M
        self._shaking, self._pitching = Shaking(USUAL_MPS2), Shaking(USUAL_RADPS)
        self._norm_mps2 = GRAVITY_MPS2  # of the specific force, low-passed
        self._pitch_radps = 0.0  # mean over the way from axle to axle
        self._mismatch_mps2 = 0.0  # wheels against body, low-passed
        self._hold = ("", 0.0)  # reason, and for how long still
        self._frozen = _Frozen()
        self._gain = _Gain()
        self._resisted = 0.0  # resistance, low-passed
        self._braked = 0.0  # drive force over weight in the direction of travel, low-passed
        self._pulled = self._rolled = 0.0  # resistance as it pulled, and as it rolls without torque, low-passed
        self._torque_brakes = False  # whether the torque was seen to brake

    @property
    def shaking_var(self) -> float:
        """Variance of c_rr by one balance, from what the machine shakes beyond the usual [-]."""
        return self._shaking.variance / GRAVITY_MPS2**2

    def judge(self, balance: Balance, resistance: float, *, skids: bool = False) -> str:
        """Why this balance shows nothing of the resistance; "" if it does.

        resistance: c_rr by this balance. skids: whether the wheels slide sideways in a turn.
        """
        self._follow(balance)
        norm_mps2 = self._norm_mps2 if self._shaking.variance else balance.norm_mps2  # a jolt is no vibration
        if not FORCE_NORMS_MPS2[0] <= norm_mps2 <= FORCE_NORMS_MPS2[1]:
            return "accelerometer"
        if fault := self._fault(balance, resistance):
            return fault
        if not _rolls(balance):
            return "standstill"
        if balance.unknown:  # engine and driveline settle for as long after it
            self._hold = balance.unknown, HOLD_S
            return balance.unknown
        pitch_radps = self._pitch_radps if self._pitching.variance else balance.pitch_radps
        curve = max(MAX_CURVE_RADPM, MAX_DIFFERENCE_RAD / self._axles_m)
        if abs(pitch_radps) > curve * max(abs(balance.speed_mps), SLOW_MPS):
            return "pitch_transient"
        return self._unsteady(balance, resistance, skids=skids)

    def _follow(self, balance: Balance) -> None:
        """Average what shakes."""
        self._norm_mps2 += min(balance.dt_s / MEAN_S, 1.0) * (balance.norm_mps2 - self._norm_mps2)
        low_s, high_s = AXLES_S
        way_s = max(low_s, min(high_s, self._axles_m / max(abs(balance.speed_mps), MIN_SPEED_MPS)))
        self._pitch_radps += min(2 * balance.dt_s / way_s, 1.0) * (balance.pitch_radps - self._pitch_radps)
        self._shaking.update(balance.dt_s, balance.accel_mps2 - balance.body_mps2)
        self._pitching.update(balance.dt_s, balance.pitch_radps)

    def _fault(self, balance: Balance, resistance: float) -> str:
        if balance.wheels_s > STALE_S:
            return "no_wheels"
        if balance.torque_s > STALE_S:
            return "no_torque"
        drives = _rolls(balance) and not balance.unknown
        # Its top and its bottom shake; torque in steps stays the same within one, sqrt(12) standard deviations wide.
        steps = 2 * math.sqrt(12 * balance.share_var)
        frozen_share = FROZEN_SHARE + steps + 2 * self._shaking.margin(MEAN_S) / GRAVITY_MPS2
        is_frozen = self._frozen.update(balance, drives=drives) >= frozen_share and self._frozen.same_s >= FROZEN_S
        if is_frozen and abs(balance.share) > ROLLS_SHARE:  # none at all is that of a machine that rolls or brakes
            return "torque_frozen"
        if abs(balance.share) > MAX_SHARE:
            return "torque_implausible"
        if drives:
            self._gain.update(balance)
            self._resisted += min(balance.dt_s / SMOOTH_S, 1.0) * (resistance - self._resisted)
        least = MIN_C_RR - self._shaking.margin(SMOOTH_S) / GRAVITY_MPS2
        return "torque_implausible" if self._resisted < least or self._gain.is_wrong else ""

    def _unsteady(self, balance: Balance, resistance: float, *, skids: bool) -> str:
        """Whether forces that the balance does not include act, or acted a moment ago."""
        may_brake = self._may_brake_unseen(balance, resistance)
        difference = balance.accel_mps2 - balance.body_mps2
        self._mismatch_mps2 += min(balance.dt_s / MEAN_S, 1.0) * (difference - self._mismatch_mps2)
        if abs(self._mismatch_mps2) > MAX_SLIP_MPS2 + self._shaking.margin(MEAN_S):
            self._hold = "slip", HOLD_S
        elif _brakes(balance):
            self._hold = "braking", HOLD_S
        elif may_brake:
            self._hold = "braking_unseen", HOLD_S
        elif resistance > MAX_C_RR + self._shaking.margin() / GRAVITY_MPS2:
            self._hold = "digging", HOLD_S
        elif skids:
            self._hold = "skid_turn", HOLD_S
        reason, left_s = self._hold
        self._hold = reason, left_s - balance.dt_s
        return reason if left_s > 0 else ""

    def _may_brake_unseen(self, balance: Balance, resistance: float) -> bool:
        """Whether the machine rolls without torque on ground that seems rougher, and nothing has shown its brakes."""
        pulls = balance.direction * balance.share
        if pulls > ROLLS_SHARE:
            self._pulled += min(balance.dt_s / SMOOTH_S, 1.0) * (resistance - self._pulled)
            self._rolled = self._pulled
        else:
            self._rolled += min(balance.dt_s / MEAN_S, 1.0) * (resistance - self._rolled)
        self._braked += min(balance.dt_s / SMOOTH_S, 1.0) * (pulls - self._braked)
        self._torque_brakes |= self._braked < BRAKES_SHARE
        is_shown = self._torque_brakes or not math.isnan(balance.brake)
        return not is_shown and pulls <= ROLLS_SHARE and self._rolled > self._pulled + ROUGHER


def _rolls(balance: Balance) -> bool:
    return abs(balance.speed_mps) >= max(MIN_SPEED_MPS, ROLLS_SIGMA * balance.speed_std_mps)


def _brakes(balance: Balance) -> bool:
    """Whether a brake is applied, or the machine slows down fast, not because the ground does it while it pulls."""
    slows_mps2 = -balance.direction * balance.accel_mps2
    return balance.brake > APPLIED or (slows_mps2 > MAX_BRAKE_MPS2 and balance.direction * balance.share < PULLS_SHARE)


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

    The accelerometer, which measures the motion's force x, shakes; that would make the slope look flat. So both are
    compared with the motion by wheels and slope, z, whose errors are others: the slope is cov(z, y) / cov(z, x) (errors
    in variables, by an instrument; Wald 1940, Durbin 1954), and cov(z, x) is the variance without the noise.

    Resistance that varies with the motion does matter: sand takes force and slows the machine down, so that more force
    comes with less acceleration, as if the sign were wrong. But sand resists all the time. With a wrong gain k, c_rr by
    a balance is k c_rr plus (k - 1) times the motion's force, which falls below 0 as the machine climbs or slows down.
    So a gain is wrong only if the ground seems to have pushed as well.
    """

    def __init__(self) -> None:
        self._means = (0.0, 0.0, 0.0)  # x, y and z, low-passed
        self._sums: tuple[float, ...] = (0.0,) * 6  # weight; x, y, z; z x, z y
        self._least = 0.0  # c_rr of late

    def update(self, balance: Balance) -> None:
        """Add a balance of a machine that drives."""
        fade, share = math.exp(-balance.dt_s / FORGET_S), min(balance.dt_s / SMOOTH_S, 1.0)
        moves = balance.accel_mps2 / GRAVITY_MPS2 + math.sin(balance.slope_x)
        newest = (balance.share - balance.unbalanced, balance.share, moves)
        x, y, z = (mean + share * (new - mean) for mean, new in zip(self._means, newest, strict=True))
        self._means = (x, y, z)
        self._least = min(fade * self._least, balance.direction * (y - x))
        news = (1.0, x, y, z, z * x, z * y)
        self._sums = tuple(fade * old + balance.dt_s * new for old, new in zip(self._sums, news, strict=True))

    @property
    def is_wrong(self) -> bool:
        """Whether no scale error of a sensor explains it, nor the ground."""
        return self._least < PUSHES and not MIN_GAIN <= self._value <= MAX_GAIN

    @property
    def _value(self) -> float:
        """The slope [-]."""
        weight = self._sums[0]
        if weight < LEAST_COMPARED_S:
            return 1.0
        x, y, z, zx, zy = (total / weight for total in self._sums[1:])
        varied = zx - z * x
        return (zy - z * y) / varied if varied > LEAST_VARIED**2 else 1.0
