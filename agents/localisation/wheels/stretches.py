"""Compares a wheel sensor with a receiver over stretches long enough to tell.

A stretch ends at SURE times the receiver's error, so jumps of fixes affect one or two, and slow errors little.
Directions are compared in the dead-reckoned frame, which gyros keep for a while; agreeing stretches give its rotation
into `map`.
"""

import cmath
from dataclasses import dataclass
from enum import Enum

from agents.dead_reckoning import MAX_WHEEL_MPS

LEAST_M, LEAST_S, MOST_S = 3.0, 1.0, 15.0  # length (by either) and duration
SURE = 4.0  # least length and contradiction, over the deviation by fixes
NEAR, FAR = 0.3, 0.4  # difference over the longer length: agrees below, contradicts above
STANDS = 0.1  # of the length by fixes; wheels below it stand
HALF = 0.625  # ratio of lengths (or inverse) beyond slip and tyres
OPPOSED = 0.5  # cosine; below its negative, directions are opposite
LEARNS = 0.2  # weight of a stretch in the usual ratio
HEADED_NS = 60 * 10**9  # time a gyro keeps direction to half a radian, with a bias of 0.5 degrees per second


class Kind(Enum):
    """How stretches of a wheel sensor compare with fixes."""

    AGREES = "agrees"
    STANDS = "stands"
    LAGS = "lags"  # rolls less than usual
    SLIPS = "slips"  # rolls more than usual
    OPPOSITE = "opposite"
    UNCLEAR = "unclear"


@dataclass(frozen=True)
class Place:
    """The machine's place [m], complex: by a receiver in `map`, by wheels in the dead-reckoned frame.

    distance_m, rolled_m: rolled in total, signed. lever_m: antenna, ahead + i left.
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
        """Antenna relative to `base_link`, in the dead-reckoned frame."""
        return self.lever_m * cmath.exp(1j * self.angle_rad)


@dataclass(frozen=True)
class Run:
    """Successive stretches that all agree or all contradict.

    stands: wheels stood in the last. off_m: summed difference. fixes_m, wheels_m: lengths, in the usual ratio.
    along_m2: sum of scalar products.
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
        """Their common verdict on the wheels."""
        if self.agrees:
            return Kind.AGREES
        if self.stands:
            return Kind.STANDS
        if self.along_m2 < -OPPOSED * self.fixes_m * self.wheels_m / self.count:
            return Kind.OPPOSITE
        ratio = self.fixes_m / max(self.wheels_m, 1e-9)
        return Kind.SLIPS if ratio < HALF else Kind.LAGS if ratio > 1 / HALF else Kind.UNCLEAR


class Stretches:
    """Compares one wheel sensor with one receiver. begin: of the current stretch."""

    def __init__(self) -> None:
        self._usual = 0.0  # length by fixes over length by wheels; 0 before they agreed
        self.forget_times()

    def forget_times(self) -> None:
        """Discard stamps; the usual ratio stays."""
        self.begin: Place | None = None
        self.agreed_ns = 0
        self._run: Run | None = None
        self._last_m, self._ended_ns = 0j, 0
        self._turn = 0j  # unit rotation from the dead-reckoned frame into `map`

    def interrupt(self) -> None:
        """Restart at the next place, after an unknown motion."""
        self.begin, self._turn = None, 0j

    def add(self, now: Place, std_m: float) -> Run | None:
        """Add a place; returns the run extended by a stretch that ends here, once it shows agreement.

        std_m: deviation by fixes since its begin.
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
        """Difference of both; before the unit is known only whether wheels stand."""
        if self._is_headed(now_ns):
            return abs(by_fixes - self._usual * self._turn * by_wheels)
        return abs(abs(by_fixes) - (self._usual or 1.0) * abs(by_wheels))

    def _is_headed(self, now_ns: int) -> bool:
        return bool(self._turn) and now_ns - self.agreed_ns < HEADED_NS

    def _learn(self, by_fixes: complex, by_wheels: complex, now_ns: int) -> None:
        """Learn direction, and ratio along it, since noise lengthens displacements by fixes."""
        turn = by_fixes / by_wheels
        headed = self._turn + turn / abs(turn) if self._is_headed(now_ns) else turn
        self._turn, self.agreed_ns = headed / abs(headed), now_ns
        ratio = (turn * self._turn.conjugate()).real
        self._usual += LEARNS * (ratio - self._usual) if self._usual else ratio

    def _continue(self, begin: Place, now: Place, by_fixes: complex, off_m: float, *, agrees: bool) -> Run:
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
