"""A wheel sensor beside a receiver: what both say of stretches that are long enough to tell.

A stretch lasts until its way is SURE times as long as the receiver's errors make it unsure. So jumps of fixes fall into
one stretch, or two, and slow errors matter little. Directions are compared in the frame of dead reckoning, which gyros
keep for a while: the turn from there into `map` is taken from stretches that agree.
"""

import cmath
from dataclasses import dataclass
from enum import Enum

from agents.dead_reckoning import MAX_WHEEL_MPS

LEAST_M, LEAST_S, MOST_S = 3.0, 1.0, 15.0  # way, by either, and time of a stretch
SURE = 4.0  # of a stretch's way, and of what contradicts: least size over the standard deviation of the way by fixes
NEAR, FAR = 0.3, 0.4  # of the longer way, what both differ by at most if they agree, at least if they contradict
STANDS = 0.1  # of the way by fixes: wheels that roll less stand
HALF = 0.625  # ratio of ways, or its inverse, beyond which they differ by more than slip and tyres make
OPPOSED = 0.5  # cosine of an angle: beyond its negative, directions are opposite
LEARNS = 0.2  # share of a stretch in the usual ratio
HEADED_NS = 60 * 10**9  # for so long a gyro keeps a direction to half a radian, even one off by 0.5 degrees per second


class Kind(Enum):
    """How stretches by a wheel sensor compare with fixes."""

    AGREES = "agrees"
    STANDS = "stands"
    LAGS = "lags"  # rolls less than usual
    SLIPS = "slips"  # rolls more than usual
    OPPOSITE = "opposite"
    UNCLEAR = "unclear"


@dataclass(frozen=True)
class Place:
    """Where the machine is [m], as complex numbers: by a receiver in `map`, by wheels in the dead-reckoned frame.

    distance_m: what the wheels have rolled, up in reverse too; rolled_m: down in reverse. angle_rad: dead-reckoned.
    lever_m: where the antenna sits, ahead + i left.
    """

    stamp_ns: int
    fix_m: complex
    wheel_m: complex
    distance_m: float
    rolled_m: float
    angle_rad: float
    lever_m: complex

    @property
    def antenna_m(self) -> complex:
        """Where the antenna is beside `base_link`, in the dead-reckoned frame."""
        return self.lever_m * cmath.exp(1j * self.angle_rad)


@dataclass(frozen=True)
class Run:
    """Stretches in a row that agree, or that contradict: how many, and where the first began.

    stands: whether the wheels stood in the last one. off_m: how far fixes and wheels are apart, in sum. fixes_m,
    wheels_m: ways by both, those of wheels in the usual ratio. along_m2: sum of products of ways along each other.
    """

    agrees: bool
    begin: Place
    stands: bool = False
    count: int = 0
    off_m: float = 0.0
    fixes_m: float = 0.0
    wheels_m: float = 0.0
    along_m2: float = 0.0

    @property
    def kind(self) -> Kind:
        """What they say of the wheels, together."""
        if self.agrees:
            return Kind.AGREES
        if self.stands:
            return Kind.STANDS
        if self.along_m2 < -OPPOSED * self.fixes_m * self.wheels_m / self.count:
            return Kind.OPPOSITE
        ratio = self.fixes_m / max(self.wheels_m, 1e-9)
        return Kind.SLIPS if ratio < HALF else Kind.LAGS if ratio > 1 / HALF else Kind.UNCLEAR


class Stretches:
    """Compares one wheel sensor with one receiver. begin: where the stretch begins that lasts."""

    def __init__(self) -> None:
        self._usual = 0.0  # way by fixes over way by wheels; 0 as long as they never agreed
        self.forget_times()

    def forget_times(self) -> None:
        """Begin anew with every stamp; the usual ratio is none of the clock's."""
        self.begin: Place | None = None
        self.agreed_ns = 0
        self._run: Run | None = None
        self._last_m, self._ended_ns = 0j, 0  # of the newest stretch
        self._turn = 0j  # from the dead-reckoned frame into `map`, of length 1

    def interrupt(self) -> None:
        """Begin anew with the next place: nobody knows what happened meanwhile."""
        self.begin, self._turn = None, 0j

    def add(self, now: Place, std_m: float) -> Run | None:
        """Take in a place; returns the run that a stretch which ends here makes longer.

        std_m: of the way by fixes since the stretch began. A stretch ends where it shows whether both agree.
        """
        if (begin := self.begin) is None:
            self.begin = now
            return None
        seconds, by_wheels = (now.stamp_ns - begin.stamp_ns) * 1e-9, now.wheel_m - begin.wheel_m
        by_fixes = now.fix_m - begin.fix_m - self._turn * (now.antenna_m - begin.antenna_m)
        far_m = max(abs(by_fixes), (self._usual or 1.0) * abs(by_wheels))
        if not 0 <= seconds < MOST_S or abs(by_fixes) > MAX_WHEEL_MPS * max(seconds, LEAST_S):
            self.begin = now
        if self.begin is now or seconds < LEAST_S or far_m < max(LEAST_M, SURE * std_m):
            return None
        off_m = self._off_m(by_fixes, by_wheels, now.stamp_ns)
        if agrees := off_m < NEAR * far_m:
            self._learn(by_fixes, by_wheels, now.stamp_ns)
        elif off_m < max(FAR * far_m, SURE * std_m):
            return None
        self.begin = now
        if not (agrees or self._usual) and now.distance_m - begin.distance_m > STANDS**2 * far_m:
            return None  # the wheels may have another unit
        return self._continue(begin, now, by_fixes, off_m, agrees=agrees)

    def _off_m(self, by_fixes: complex, by_wheels: complex, now_ns: int) -> float:
        """How far both are apart; of wheels whose unit is not known yet only whether they stand."""
        if self._is_headed(now_ns):
            return abs(by_fixes - self._usual * self._turn * by_wheels)
        return abs(abs(by_fixes) - (self._usual or 1.0) * abs(by_wheels))

    def _is_headed(self, now_ns: int) -> bool:
        return bool(self._turn) and now_ns - self.agreed_ns < HEADED_NS

    def _learn(self, by_fixes: complex, by_wheels: complex, now_ns: int) -> None:
        """Learn the direction, and the usual ratio along it: noise makes each way by fixes longer."""
        turn = by_fixes / by_wheels
        headed = self._turn + turn / abs(turn) if self._is_headed(now_ns) else turn
        self._turn, self.agreed_ns = headed / abs(headed), now_ns
        ratio = (turn * self._turn.conjugate()).real
        self._usual += LEARNS * (ratio - self._usual) if self._usual else ratio

    def _continue(self, begin: Place, now: Place, by_fixes: complex, off_m: float, *, agrees: bool) -> Run:
        """The run with one more stretch; fixes that jump to and fro are no way that a machine goes."""
        by_wheels, run, unit = now.wheel_m - begin.wheel_m, self._run, self._usual or 1.0
        goes_back = (by_fixes * self._last_m.conjugate()).real < 0
        lasts = run is not None and (begin.stamp_ns - self._ended_ns) * 1e-9 < MOST_S
        if run is None or not lasts or agrees != run.agrees or (run.kind == Kind.STANDS and goes_back):
            run = Run(agrees, begin)
        self._ended_ns, is_headed = now.stamp_ns, self._is_headed(now.stamp_ns)
        along_m2 = is_headed * unit * (by_fixes * (self._turn * by_wheels).conjugate()).real
        sums = run.off_m + off_m, run.fixes_m + abs(by_fixes), run.wheels_m + unit * abs(by_wheels)
        stands = unit * (now.distance_m - begin.distance_m) < STANDS * abs(by_fixes)
        self._last_m = by_fixes
        self._run = Run(agrees, run.begin, stands, run.count + 1, *sums, run.along_m2 + along_m2)
        return self._run
