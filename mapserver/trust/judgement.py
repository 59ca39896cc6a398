"""From a difference of two maps to what it means: for each reason, how far beyond its limit it is."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from math import hypot, log, sqrt

from mapserver.trust.comparison import CELLS_PER_DRAW, Difference, Gain
from mapserver.trust.machine_vote import AGREE, DISAGREE, UNKNOWN
from mapserver.trust.shift import Shift
from protocol.config import require_positive

_ALIKE = 0.75  # of the limit: above it nothing is said


@dataclass(frozen=True)
class TrustConfig:
    """When machines count as contradicting each other.

    period_s: only cells driven in the same period are compared: rain and repaving are no contradiction. periods: so
    many of a machine's newest periods are remembered; a repaired machine is cleared when most of them are good.
    min_cells: of about 4 m2 that two machines must share; with fewer nothing is decided.
    gain_limit: ratio of coefficients; agents know mass and torque to 3 % each, a class is wrong from about 1.25.
    share: of the ground that must differ by a gain in the same direction, and of the borders that must speak for a
    displacement: a repaved corner is neither.
    zero_error: of c_rr, an accelerometer's zero error divided by g; it may explain a difference on hard ground.
    offset_limit_m: of positions; what slow receiver errors leave after hours. error_length_m: metres over which a
    position error stays the same (twice 30 s at 3 m/s). sigmas: so many standard errors are added to each limit.
    tolerance: of log(c_rr + 0.01); dry and wet dirt are 0.34 apart. agreement: share of the ground on which two
    machines must agree within it.
    stuck_spread: a sensor is stuck where its values vary by less than this share of what the others' do, if those vary
    by at least min_spread.
    clock_limit_s: what batches and links may explain. clock_steady_s, clock_span_s: a clock is wrong where its lead
    stays within so much for so long; the lag of a machine that catches up shrinks faster.
    """

    period_s: float = 1800.0
    periods: int = 16
    min_cells: int = 20
    gain_limit: float = 1.15
    share: float = 0.75
    zero_error: float = 0.003
    offset_limit_m: float = 1.5
    error_length_m: float = 200.0
    sigmas: float = 2.0
    tolerance: float = 0.3
    agreement: float = 0.6
    stuck_spread: float = 0.25
    min_spread: float = 0.3
    clock_limit_s: float = 300.0
    clock_steady_s: float = 60.0
    clock_span_s: float = 600.0

    def __post_init__(self) -> None:
        require_positive(self, self.__dataclass_fields__)
        if self.gain_limit <= 1:
            raise ValueError(f"gain_limit: {self.gain_limit} is not above 1")
        for name in ("share", "agreement", "stuck_spread"):
            if getattr(self, name) >= 1:
                raise ValueError(f"{name}: {getattr(self, name)} is not below 1")
        for small, large in (("clock_steady_s", "clock_limit_s"), ("clock_steady_s", "clock_span_s")):
            if getattr(self, small) >= getattr(self, large):
                raise ValueError(f"{small}: must be below {large}")


class Reason(StrEnum):
    """In which way a machine contradicts the others."""

    GAIN = "gain"
    OFFSET = "offset"
    CLOCK = "clock"
    STUCK = "stuck"
    DISAGREES = "disagrees"  # in no way that has a name


@dataclass(frozen=True)
class Finding:
    """How far one difference goes (1: at its limit), and what that means: AGREE, UNKNOWN or DISAGREE."""

    excess: float = 0.0
    state: int = UNKNOWN


GROUND = (Reason.GAIN, Reason.OFFSET, Reason.STUCK, Reason.DISAGREES)
_NO_FINDING = Finding()


def judge(difference: Difference | None, config: TrustConfig, sigmas: float) -> dict[Reason, Finding]:
    """Findings about the first of two maps, for every reason that shows in the ground.

    Between maps that have nothing in common, gain and offset mean nothing.
    """
    findings = dict.fromkeys(GROUND, _NO_FINDING)
    if difference is None:
        return findings
    findings[Reason.STUCK] = _stuck(difference.spreads, config)
    if DISAGREE in (findings[Reason.STUCK].state, _stuck(difference.spreads[::-1], config).state):
        return findings
    findings[Reason.DISAGREES] = _disagrees(difference, config, sigmas)
    if findings[Reason.DISAGREES].state != DISAGREE:
        findings[Reason.GAIN] = _gain(difference.gain, config, sigmas)
        findings[Reason.OFFSET] = _offset(difference.shift, config, sigmas)
    return findings


def _stuck(spreads: tuple[float, float], config: TrustConfig) -> Finding:
    own, theirs = spreads
    if theirs < config.min_spread:
        return _NO_FINDING
    excess = config.stuck_spread * theirs / max(own, 1e-3)
    return Finding(excess, DISAGREE if excess > 1 else AGREE)


def _disagrees(difference: Difference, config: TrustConfig, sigmas: float) -> Finding:
    error = 0.5 * sqrt(CELLS_PER_DRAW / difference.cells)  # of a share, at most
    excess = (1 - difference.agreement) / (1 - config.agreement + sigmas * error)
    return Finding(excess, DISAGREE if excess > 1 else AGREE if excess <= _ALIKE else UNKNOWN)


def _gain(gain: Gain, config: TrustConfig, sigmas: float) -> Finding:
    limit = log(config.gain_limit) + config.zero_error / gain.c_rr
    excess = abs(gain.log) / (limit + sigmas * gain.std)
    if excess > 1 and gain.share >= config.share:
        return Finding(excess, DISAGREE)
    return Finding(excess, AGREE if abs(gain.log) <= limit else UNKNOWN)


def _offset(shift: Shift | None, config: TrustConfig, sigmas: float) -> Finding:
    if shift is None:
        return _NO_FINDING
    far_m, limit_m = hypot(shift.east_m, shift.north_m), config.offset_limit_m
    excess = far_m / (limit_m + sigmas * shift.std_m)
    if excess > 1 and shift.share >= config.share:
        return Finding(excess, DISAGREE)
    agrees = far_m <= limit_m and shift.std_m <= limit_m
    return Finding(excess, AGREE if agrees else UNKNOWN)
