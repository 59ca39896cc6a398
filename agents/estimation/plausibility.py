"""Whether a force balance is usable; if not, a one-word reason for health and counters.

A machine that stands, brakes, digs, or slips in wheels or driveline shows nothing of the ground's resistance. At a
change of slope its axles stand on two slopes. Sensors fall silent, freeze, saturate, or use a wrong unit.

Unmeasured brakes look like rough ground: downhill at constant speed without torque, c_rr would equal the grade. So
coasting on ground that seems rougher than while pulling counts as braking, unless brakes are read, or torque has been
seen to brake.
"""

import math

from agents.estimation.balance import SLOW_MPS, Balance
from agents.estimation.shaking import Shaking
from protocol.units import GRAVITY_MPS2

# Reasons that invalidate the slope too, leaving presence and mass.
SLOPE_TOO = frozenset({"pitch_transient", "accelerometer"})
# Reasons that are sensor faults.
FAULTS = frozenset({"accelerometer", "no_torque", "no_wheels", "torque_frozen", "torque_implausible"})
# Plausible norm of the specific force [m/s2]; neither g nor mm/s2.
FORCE_NORMS_MPS2 = (5.0, 15.0)
STALE_S = 0.5  # age at which torque or wheel readings expire
# Speed in standard deviations from which wheels roll in a known direction: 0.15 m/s with 100 ticks, a wheel of 0.75 m
# and 20 Hz. Below the second number they may roll into a dip.
ROLLS_SIGMA, MIN_SPEED_MPS = 3.0, 0.05
# Bounds of the slope's change per metre, pitch rate over speed, and between a loader's axles, 2.5 degrees; shorter
# machines may curve more. A shaking machine's rate is averaged over a wheelbase.
MAX_CURVE_RADPM, MAX_DIFFERENCE_RAD = 0.013, 0.0429
# Usual shaking per step, ahead and in pitch. A loader on tyres has 0.15 m/s2 and 0.002 rad/s, 0.013 rad/s at the foot
# of a ramp. The second is half of what is too much.
USUAL_MPS2, USUAL_RADPS = 0.25, 0.013
AXLES_M = 3.3  # assumed wheelbase where unknown: a loader's
AXLES_S = (0.5, 1.0)  # bounds of the time to drive it; at creeping speed gyro bias would turn the slope
MAX_BRAKE_MPS2 = 1.5  # faster deceleration than by any ground but sand
# Drive force over weight beyond which a machine pulls, and sand or a ramp slows it, not brakes. Above noise and bias of
# coasting torque, below what gravel resists.
PULLS_SHARE = 0.02
APPLIED = 0.01  # applied share of a brake; less is play
# Drive force over weight in the direction of travel. Below the first the machine coasts, but for noise and bias; below
# the second, torque brakes beyond engine drag.
ROLLS_SHARE, BRAKES_SHARE = 0.015, -0.06
ROUGHER = 0.02  # c_rr while coasting above that while pulling, beyond noise and bias
MAX_C_RR = 0.45  # upper bound of c_rr; beyond it, the bucket digs
MIN_C_RR = -0.08  # lower bound of c_rr; below it torque is missing, as no bias is so large
MAX_SLIP_MPS2 = 1.0  # wheel less body acceleration at which wheels spin or lock
MEAN_S = 0.3  # time constant of that comparison
HOLD_S = 0.5  # settling time after slip, brakes, digging, skid turns
# Torque constant for so long, while the motion's force changes by this share of the weight, is frozen or saturated.
FROZEN_S, FROZEN_SHARE = 2.0, 0.03
MAX_SHARE = 1.2  # upper bound of drive force over weight; tyres transmit little more than their load
# Bounds of drive force over the motion's force; 1 with correct units.
MIN_GAIN, MAX_GAIN = 0.4, 2.5
PUSHES = -0.03  # c_rr of one balance beyond bias and shocks: the ground seems to push
SMOOTH_S = 1.0  # smoothing before comparison
FORGET_S = 120.0  # memory of the comparison
LEAST_COMPARED_S = 20.0
LEAST_VARIED = 0.3 / GRAVITY_MPS2  # standard deviation of the motion's force over weight


class Plausibility:
    """Judges successive balances. axles_m: the wheelbase, 0 if unknown."""

    def __init__(self, axles_m: float = 0.0) -> None:
        self._axles_m = axles_m or AXLES_M
        self._shaking, self._pitching = Shaking(USUAL_MPS2), Shaking(USUAL_RADPS)
        self._norm_mps2 = GRAVITY_MPS2  # low-passed specific force
        self._pitch_radps = 0.0  # mean over a wheelbase
        self._mismatch_mps2 = 0.0  # low-passed acceleration of wheels less body
        self._hold = ("", 0.0)  # reason, and its remaining time
        self._frozen = _Frozen()
        self._gain = _Gain()
        self._resisted = 0.0  # low-passed resistance
        self._braked = 0.0  # low-passed drive force over weight in the direction of travel
        self._pulled = self._rolled = 0.0  # low-passed resistance while pulling, and while coasting
        self._torque_brakes = False

    @property
    def shaking_var(self) -> float:
        """Variance of one balance's c_rr by unusual shaking [-]."""
        return self._shaking.variance / GRAVITY_MPS2**2

    def judge(self, balance: Balance, resistance: float, *, skids: bool = False) -> str:
        """Why this balance shows nothing of the resistance, or "".

        resistance: c_rr of this balance. skids: whether wheels slide sideways in a turn.
        """
        self._follow(balance)
        norm_mps2 = self._norm_mps2 if self._shaking.variance else balance.norm_mps2  # a single shock is no vibration
        if not FORCE_NORMS_MPS2[0] <= norm_mps2 <= FORCE_NORMS_MPS2[1]:
            return "accelerometer"
        if fault := self._fault(balance, resistance):
            return fault
        if not _rolls(balance):
            return "standstill"
        if balance.unknown:  # engine and driveline settle as long afterwards
            self._hold = balance.unknown, HOLD_S
            return balance.unknown
        pitch_radps = self._pitch_radps if self._pitching.variance else balance.pitch_radps
        curve = max(MAX_CURVE_RADPM, MAX_DIFFERENCE_RAD / self._axles_m)
        if abs(pitch_radps) > curve * max(abs(balance.speed_mps), SLOW_MPS):
            return "pitch_transient"
        return self._unsteady(balance, resistance, skids=skids)

    def _follow(self, balance: Balance) -> None:
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
        # Extremes shake; stepped torque is constant within a step, sqrt(12) standard deviations wide.
        steps = 2 * math.sqrt(12 * balance.share_var)
        frozen_share = FROZEN_SHARE + steps + 2 * self._shaking.margin(MEAN_S) / GRAVITY_MPS2
        is_frozen = self._frozen.update(balance, drives=drives) >= frozen_share and self._frozen.same_s >= FROZEN_S
        if is_frozen and abs(balance.share) > ROLLS_SHARE:  # zero torque is normal while coasting or braking
            return "torque_frozen"
        if abs(balance.share) > MAX_SHARE:
            return "torque_implausible"
        if drives:
            self._gain.update(balance)
            self._resisted += min(balance.dt_s / SMOOTH_S, 1.0) * (resistance - self._resisted)
        least = MIN_C_RR - self._shaking.margin(SMOOTH_S) / GRAVITY_MPS2
        return "torque_implausible" if self._resisted < least or self._gain.is_wrong else ""

    def _unsteady(self, balance: Balance, resistance: float, *, skids: bool) -> str:
        """Reason if unmodelled forces act, or acted within the hold time."""
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
        """Whether the machine coasts on seemingly rougher ground and its brakes are not observable."""
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
    """Whether a brake is applied, or the machine slows down too fast without pulling."""
    slows_mps2 = -balance.direction * balance.accel_mps2
    return balance.brake > APPLIED or (slows_mps2 > MAX_BRAKE_MPS2 and balance.direction * balance.share < PULLS_SHARE)


class _Frozen:
    """How long drive force has been constant, and how much the motion's force has changed meanwhile."""

    def __init__(self) -> None:
        self.same_s = 0.0
        self._share = math.nan
        self._motion = self._low = self._high = 0.0

    def update(self, balance: Balance, *, drives: bool) -> float:
        """Add a balance; returns that change [-]."""
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
    """Drive force over the motion's force: a regression slope; 1 while variation is too small.

    Only their common variation as the machine starts, stops and climbs counts, not bias or constant resistance. The
    accelerometer's x shakes, which would flatten the slope. The motion by wheels and slope, z, has other errors and
    serves as instrument: the slope is cov(z, y) / cov(z, x) (errors in variables; Wald 1940, Durbin 1954).

    Varying resistance biases it: sand takes force and slows the machine, as if the sign were wrong. But with a wrong
    gain k, a balance measures k c_rr plus (k - 1) times the motion's force, which turns negative in climbs or braking.
    So a gain is wrong only if the ground seems to push as well.
    """

    def __init__(self) -> None:
        self._means = (0.0, 0.0, 0.0)  # low-passed x, y and z
        self._sums: tuple[float, ...] = (0.0,) * 6  # weight; x, y, z; z x, z y
        self._least = 0.0  # recent minimum of c_rr

    def update(self, balance: Balance) -> None:
        """Add a balance of a driving machine."""
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
        """Whether neither sensor scale nor ground explains it."""
        return self._least < PUSHES and not MIN_GAIN <= self._value <= MAX_GAIN

    @property
    def _value(self) -> float:
        weight = self._sums[0]
        if weight < LEAST_COMPARED_S:
            return 1.0
        x, y, z, zx, zy = (total / weight for total in self._sums[1:])
        varied = zx - z * x
        return (zy - z * y) / varied if varied > LEAST_VARIED**2 else 1.0
