"""From a difference to what it means: how far beyond its limit it is, and which machines are outvoted because of it."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from math import hypot, log, sqrt

import numpy as np

from mapserver.calibration.select import FAULT_SIGMAS, MachineErrors
from mapserver.trust.comparison import Difference, Gain
from mapserver.trust.shift import Shift
from mapserver.trust.tuning import TUNING, TrustTuning
from protocol.arrays import Ints

AGREE, UNKNOWN, DISAGREE = 1, 0, -1
CLOCK_LIMIT_S = 300.0  # lead or lag that batches and links may explain
# A clock is wrong where its lead stays within so much for so long; the lag of a machine that catches up shrinks faster.
CLOCK_STEADY_S, CLOCK_SPAN_S = 60.0, 600.0
LEADS, LEADS_NEEDED = 16, 8  # leads that are noted in a span, and how many of them tell


class Reason(StrEnum):
    """In which way a machine contradicts the others."""

    GAIN = "gain"
    OFFSET = "offset"
    CLOCK = "clock"
    STUCK = "stuck"
    DISAGREES = "disagrees"  # in no way that has a name
    BEYOND_DATA_SHEET = "beyond_data_sheet"  # zero or scale is a fault, though the map may be right without it


@dataclass(frozen=True)
class Judgement:
    """How far one difference goes (1: at its limit), and what that means: AGREE, UNKNOWN or DISAGREE."""

    excess: float = 0.0
    state: int = UNKNOWN


GROUND = (Reason.GAIN, Reason.OFFSET, Reason.STUCK, Reason.DISAGREES)
VOTED = (*GROUND, Reason.CLOCK)
_NO_JUDGEMENT = Judgement()


# --- the ground ------------------------------------------------------------------------------------------------------


def judge(difference: Difference | None, sigmas: float, tuning: TrustTuning = TUNING) -> dict[Reason, Judgement]:
    """Judge the first of two maps, for every reason that shows in the ground.

    sigmas: so many standard errors are added to each limit. Between maps that have nothing in common, gain and offset
    mean nothing.
    """
    judgements = dict.fromkeys(GROUND, _NO_JUDGEMENT)
    if difference is None:
        return judgements
    judgements[Reason.STUCK] = _stuck(difference.spreads, tuning)
    if DISAGREE in (judgements[Reason.STUCK].state, _stuck(difference.spreads[::-1], tuning).state):
        return judgements
    judgements[Reason.DISAGREES] = _disagrees(difference, sigmas, tuning)
    if judgements[Reason.DISAGREES].state != DISAGREE:
        judgements[Reason.GAIN] = _gain(difference.gain, sigmas, tuning)
        judgements[Reason.OFFSET] = _offset(difference.shift, sigmas, tuning)
    return judgements


def _stuck(spreads: tuple[float, float], tuning: TrustTuning) -> Judgement:
    own, theirs = spreads
    if theirs < tuning.min_spread:
        return _NO_JUDGEMENT
    excess = tuning.stuck_spread * theirs / max(own, 1e-3)
    return Judgement(excess, DISAGREE if excess > 1 else AGREE)


def _disagrees(difference: Difference, sigmas: float, tuning: TrustTuning) -> Judgement:
    error = 0.5 * sqrt(tuning.cells_per_draw / difference.cells)  # of a share, at most
    excess = (1 - difference.agreement) / (1 - tuning.agreement + sigmas * error)
    return Judgement(excess, DISAGREE if excess > 1 else AGREE if excess <= tuning.alike else UNKNOWN)


def _gain(gain: Gain, sigmas: float, tuning: TrustTuning) -> Judgement:
    limit = log(tuning.gain_limit) + tuning.zero_error / gain.c_rr
    excess = abs(gain.log) / (limit + sigmas * gain.std)
    if excess > 1 and gain.share >= tuning.share:
        return Judgement(excess, DISAGREE)
    return Judgement(excess, AGREE if abs(gain.log) <= limit else UNKNOWN)


def _offset(shift: Shift | None, sigmas: float, tuning: TrustTuning) -> Judgement:
    if shift is None:
        return _NO_JUDGEMENT
    far_m, limit_m = hypot(shift.east_m, shift.north_m), tuning.offset_limit_m
    excess = far_m / (limit_m + sigmas * shift.std_m)
    if excess > 1 and shift.share >= tuning.share:
        return Judgement(excess, DISAGREE)
    agrees = far_m <= limit_m and shift.std_m <= limit_m
    return Judgement(excess, AGREE if agrees else UNKNOWN)


# --- sensors ---------------------------------------------------------------------------------------------------------


def beyond_data_sheet(state: MachineErrors | None) -> Judgement:
    """Judge what calibration says of a machine: None where it says nothing."""
    if state is None:
        return _NO_JUDGEMENT
    excess = max(sigmas / limit for sigmas, limit in zip(state.beyond, FAULT_SIGMAS, strict=True))
    return Judgement(excess, DISAGREE if excess > 1 else AGREE)


# --- clocks ----------------------------------------------------------------------------------------------------------


class ClockLeads:
    """Steady leads of one machine's stamps over those of the others, whenever its samples arrive.

    Only stamps are compared with stamps: sites replay old logs, and run faster than real time. A machine that was
    offline and catches up is behind too, but its lag shrinks; where the others have stopped, the lead of one that works
    on grows.
    """

    def __init__(self) -> None:
        self._newest: dict[str, int] = {}
        self._noted: dict[str, deque[tuple[int, dict[str, int]]]] = {}

    def add(self, machine: str, newest_ns: int) -> None:
        """Note the newest stamp of a batch; in order of arrival."""
        noted = self._noted.setdefault(machine, deque(maxlen=LEADS + 1))
        if not noted or abs(newest_ns - noted[-1][0]) >= CLOCK_SPAN_S * 1e9 / LEADS:
            noted.append((newest_ns, dict(self._newest)))
        self._newest[machine] = newest_ns

    def compare(self, machine: str, other: str) -> tuple[float, Judgement]:
        """By how much [s] one machine's stamps are ahead of another's, NaN where that is not known; what it means."""
        stamps = [(own, newest[other]) for own, newest in self._noted[machine] if other in newest]
        if len(stamps) < LEADS_NEEDED:
            return np.nan, _NO_JUDGEMENT
        own, theirs = np.array(stamps, np.int64).T
        leads_s = (own - theirs) / 1e9
        lead_s = float(np.median(leads_s))
        excess = abs(lead_s) / CLOCK_LIMIT_S
        if np.abs(leads_s).max() <= CLOCK_LIMIT_S:
            return lead_s, Judgement(excess, AGREE)
        steady = np.ptp(leads_s) <= CLOCK_STEADY_S and np.ptp(own) >= 0.75e9 * CLOCK_SPAN_S
        return lead_s, Judgement(excess, DISAGREE if steady and excess > 1 else UNKNOWN)


# --- the vote --------------------------------------------------------------------------------------------------------


def outvoted(states: Ints) -> list[tuple[int, ...]]:
    """For each machine the group of others by which it is outvoted; empty where it is not.

    states: (n, n) AGREE, UNKNOWN or DISAGREE of row's machine with column's.
    A machine is outvoted by a group of at least two that it disagrees with, and that agree among themselves, if the
    group is larger than the machine's own side, and at least half of all that can be compared with it: of two machines
    nobody knows which is right, nor when most of a fleet is wrong.
    """
    return [_outvoters(states, machine) for machine in range(len(states))]


def faulty(judgements: Sequence[Judgement]) -> list[tuple[int, ...]]:
    """For each machine beyond its data sheet the others that are not, if these are as many or more; else empty.

    A gain is measured, not voted on, but where most machines seem wrong it is more likely the site's doing: and a map
    of nobody is no map.
    """
    right = tuple(i for i, judgement in enumerate(judgements) if judgement.state != DISAGREE)
    rest = right if 2 * len(right) >= len(judgements) else ()
    return [() if i in right else rest for i in range(len(judgements))]


def _outvoters(states: Ints, machine: int) -> tuple[int, ...]:
    against = [int(other) for other in (states[machine] == DISAGREE).nonzero()[0]]
    side = 1 + int((states[machine] == AGREE).sum())
    group = max((_group(states, seed, against) for seed in against), key=len, default=())
    decides = len(group) >= 2 and len(group) > side and 2 * len(group) >= len(against) + side
    return group if decides else ()


def _group(states: Ints, seed: int, candidates: list[int]) -> tuple[int, ...]:
    """The seed and those who agree with it, without those who disagree with one already in."""
    group = [seed]
    for other in candidates:
        if states[seed, other] == AGREE and all(states[other, member] != DISAGREE for member in group):
            group.append(other)
    return tuple(sorted(group))
