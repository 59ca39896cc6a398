"""Judges differences by their limits, and which machines are outvoted."""

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
CLOCK_LIMIT_S = 300.0  # lead or lag [s] that batches and links may explain
# A clock is wrong if its lead stays in this range for this span [s]; a machine that catches up changes faster.
CLOCK_STEADY_S, CLOCK_SPAN_S = 60.0, 600.0
LEADS, LEADS_NEEDED = 16, 8  # leads per span, and how many are needed


class Reason(StrEnum):
    """How a machine contradicts others."""

    GAIN = "gain"
    OFFSET = "offset"
    CLOCK = "clock"
    STUCK = "stuck"
    DISAGREES = "disagrees"  # disagrees in no way that has a name
    BEYOND_DATA_SHEET = "beyond_data_sheet"  # a faulty bias or scale, even if the map is right


@dataclass(frozen=True)
class Judgement:
    """Excess of a difference (1: at its limit), and AGREE, UNKNOWN or DISAGREE."""

    excess: float = 0.0
    state: int = UNKNOWN


GROUND = (Reason.GAIN, Reason.OFFSET, Reason.STUCK, Reason.DISAGREES)
VOTED = (*GROUND, Reason.CLOCK)
_NO_JUDGEMENT = Judgement()


# --- the ground ------------------------------------------------------------------------------------------------------


def judge(difference: Difference | None, sigmas: float, tuning: TrustTuning = TUNING) -> dict[Reason, Judgement]:
    """Judge the first of two maps for each reason in GROUND.

    sigmas: standard errors added to limits. Gain and offset mean nothing between unrelated maps.
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
    error = 0.5 * sqrt(tuning.cells_per_draw / difference.cells)  # of a share, upper bound
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
    """Judge a calibration, None if unknown."""
    if state is None:
        return _NO_JUDGEMENT
    excess = max(sigmas / limit for sigmas, limit in zip(state.beyond, FAULT_SIGMAS, strict=True))
    return Judgement(excess, DISAGREE if excess > 1 else AGREE)


# --- clocks ----------------------------------------------------------------------------------------------------------


class ClockLeads:
    """Steady leads of machines' stamps over others'.

    Stamps are compared with stamps only: sites replay logs, faster than real time. The lag of a machine that catches up
    shrinks; a lead over stopped machines grows.
    """

    def __init__(self) -> None:
        self._newest: dict[str, int] = {}
        self._noted: dict[str, deque[tuple[int, dict[str, int]]]] = {}

    def add(self, machine: str, newest_ns: int) -> None:
        """Note the newest stamp of a batch, by arrival."""
        noted = self._noted.setdefault(machine, deque(maxlen=LEADS + 1))
        if not noted or abs(newest_ns - noted[-1][0]) >= CLOCK_SPAN_S * 1e9 / LEADS:
            noted.append((newest_ns, dict(self._newest)))
        self._newest[machine] = newest_ns

    def compare(self, machine: str, other: str) -> tuple[float, Judgement]:
        """Lead [s] of a machine over another, NaN if unknown, and its judgement."""
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
    """The group that outvotes each machine, or nothing. states: (n, n), row's with column's machine.

    At least two machines that it disagrees with and that agree among themselves; more than the machine's own side, and
    at least half of all comparable machines. Of two, or in a mostly wrong fleet, nobody knows who is right.
    """
    return [_outvoters(states, machine) for machine in range(len(states))]


def faulty(judgements: Sequence[Judgement]) -> list[tuple[int, ...]]:
    """The sound machines for each one beyond its data sheet, if they are at least half; else nothing.

    A gain is measured, not voted on. But if most seem wrong, the site is the likelier cause, and an empty map is no
    map.
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
    """Those that agree with the seed and not disagree among themselves."""
    group = [seed]
    for other in candidates:
        if states[seed, other] == AGREE and all(states[other, member] != DISAGREE for member in group):
            group.append(other)
    return tuple(sorted(group))
