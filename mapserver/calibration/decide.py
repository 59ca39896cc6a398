"""Which corrections count: a person's, else the solver's, else none.

A person's decision stands until withdrawn. Solves change with every sample, but maps should be stable. Hysteresis: a
correction is replaced only if two solves in a row differ from it by more than their standard deviation; all machines at
once and rarely, because the map is rebuilt. A new machine without corrections needs one solve.

A machine has one scale and one lateral bias; once known, they count for older samples that had none. A bias belongs to
its epoch. All times are site time.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from mapserver.calibration.calibrate import Solution
from mapserver.calibration.correction import (
    ANY_SHARE,
    LAST_NS,
    LEVEL_SHARE,
    UNCORRECTED,
    Correction,
    SampleCorrections,
    at,
    paint,
    values,
)
from mapserver.calibration.decision import PERSON, SOLVER, CalibrationDecision
from mapserver.calibration.ledger import EPOCH_NS, NOTHING_STATED, Stated
from mapserver.calibration.select import FAULT_SIGMAS, state_of
from mapserver.calibration.tuning import TUNING
from protocol.units import HOUR_NS, MINUTE_NS

# Interval of the solver's decisions, each of which folds samples again; a new machine has few, and decides whenever
# its driving time has doubled.
EVERY_NS = 10 * MINUTE_NS
IN_A_ROW = 2  # differing solves needed; one for a new machine without corrections
LEAST_ZERO, LEAST_SCALE = 0.0005, 0.005  # smaller differences do not improve maps
LEAST_ROLLS, TYPICAL_C_RR = 0.04, 0.04  # least change of rolling (two deviations at best), at this c_rr
FIRST_NS = 10 * MINUTE_NS  # age of a machine up to which its map is new
FROZEN_NS = 4 * HOUR_NS  # age of an epoch at which its bias is final
MOST_STEP_NS = 10 * MINUTE_NS  # longest step between judgements; more is a wrong clock or a night


class CalibrationDecisions:
    """The corrections that count.

    decided_ns: site time of the solver's last decision, or None. confirmed: machines confirmed by the last judgement,
    and as of when [ns].
    """

    def __init__(self, decisions: Iterable[CalibrationDecision] = ()) -> None:
        self._spans: dict[str, dict[str, list[Correction]]] = {SOLVER: {}, PERSON: {}}  # by machine, sorted by time
        self._newest: dict[tuple[str, str], CalibrationDecision] = {}
        self._corrections = UNCORRECTED
        self._changed: set[str] = set()  # machines with stale corrections above
        self._hysteresis = Hysteresis()
        self._waiting: dict[str, CalibrationDecision] = {}  # by machine: wanted, but too early
        self._shown: dict[str, Correction] = {}  # by machine: last correction with a scale from evidence
        self._as_of_ns: dict[str, int] = {}  # by machine; see `as_of_ns`
        self.decided_ns: int | None = None
        self.confirmed: Mapping[str, int] = {}
        for decision in decisions:
            self.add(decision)

    @property
    def corrections(self) -> SampleCorrections:
        """All corrections that count."""
        if self._changed:
            self._corrections = self._corrections.replaced({name: self._of(name) for name in self._changed})
            self._changed.clear()
        return self._corrections

    def of_solver(self) -> list[Correction]:
        """Newest correction of each machine by the solver, even if overridden."""
        return [spans[-1] for spans in self._spans[SOLVER].values() if spans]

    def shown(self) -> list[Correction]:
        """Last correction of each machine with a scale from evidence."""
        return list(self._shown.values())

    def newest(self, machine: str) -> CalibrationDecision | None:
        """The decision behind a machine's newest correction, or None."""
        by = PERSON if self._spans[PERSON].get(machine) else SOLVER
        return self._newest.get((by, machine)) if self._spans[by].get(machine) else None

    def as_of_ns(self, machine: str) -> int:
        """As of when a machine's newest correction holds.

        Its decision or last confirmation, but at most the end of the machine's last epoch (site time).
        """
        by_person = self._newest[PERSON, machine] if self._spans[PERSON].get(machine) else None
        return by_person.stamp_ns if by_person else self._as_of_ns.get(machine, 0)

    def confirm(self, confirmed: Mapping[str, int]) -> None:
        """Confirm machines' newest corrections, as of these times [ns]."""
        self._as_of_ns |= confirmed

    def add(self, decision: CalibrationDecision) -> None:
        """Make a decision count."""
        machine = decision.machine
        spans = self._spans[decision.by].setdefault(machine, [])
        if not decision.corrections:
            spans.clear()
        for one in decision.corrections:
            paint(spans, one)
        self._newest[decision.by, machine] = decision
        if decision.by == SOLVER:
            self.decided_ns = decision.stamp_ns
            self._waiting.pop(machine, None)
            self._hysteresis.decided(machine, decision.corrections)
            for one in decision.corrections[-1:]:
                if one.to_ns == LAST_NS:
                    self.confirm({machine: _as_of_ns(one, decision.stamp_ns)})
                if one.most_share >= ANY_SHARE and not decision.remembered:
                    self._shown[machine] = one
        self._changed.add(machine)

    def judge(self, calibration: Solution, now_ns: int, *, asked: bool = False) -> list[CalibrationDecision]:
        """The solver's decisions; the caller stores each, then calls `add`. Others wait for the next judgement.

        calibration: may lack machines. asked: by a person, who gets every difference.
        """
        self._hysteresis.watch(now_ns)
        confirmed = {}
        for machine, proposed in _by_machine(calibration.corrections).items():
            if self._spans[PERSON].get(machine):
                continue
            counts = self._spans[SOLVER].get(machine, [])
            stated = calibration.stated.get(machine, {})
            changed = self._hysteresis.replacing(machine, proposed, counts, stated, asked=asked)
            if counts and not self._hysteresis.differs_now(machine, proposed[-1].from_ns):
                confirmed[machine] = _as_of_ns(proposed[-1], now_ns)
            self._waiting.pop(machine, None)
            if changed:
                begins_ns = calibration.begins_ns.get(machine, 0)
                spans = *_before(proposed[0], changed, counts, stated, begins_ns), *_filled(counts, changed), *changed
                remembered = machine in calibration.remembered
                self._waiting[machine] = CalibrationDecision(machine, SOLVER, "", now_ns, spans, remembered)
        self.confirm(confirmed)
        self.confirmed = confirmed
        if not asked and self.decided_ns is not None and self.decided_ns <= now_ns < self._due_ns(calibration, now_ns):
            return []
        wanted = (each for name, each in sorted(self._waiting.items()) if not self._spans[PERSON].get(name))
        return [replace(each, stamp_ns=now_ns) for each in wanted]

    def _due_ns(self, calibration: Solution, now_ns: int) -> int:
        """Site time from which the solver may decide again."""
        assert self.decided_ns is not None
        first_ns = min(calibration.begins_ns.values(), default=0)
        driven_ns = max(0, self.decided_ns - first_ns) if first_ns <= now_ns else EVERY_NS  # otherwise a clock is ahead
        return self.decided_ns + min(driven_ns, EVERY_NS)

    def _of(self, machine: str) -> list[Correction]:
        """A machine's corrections, people's over the solver's."""
        spans = list(self._spans[SOLVER].get(machine, ()))
        for one in self._spans[PERSON].get(machine, ()):
            paint(spans, one)
        return spans


def _as_of_ns(newest: Correction, now_ns: int) -> int:
    """A standing machine adds no evidence."""
    return min(now_ns, newest.from_ns + EPOCH_NS)


def _before(
    first: Correction,
    changed: Sequence[Correction],
    counts: Sequence[Correction],
    stated: Mapping[int, Stated],
    begins_ns: int,
) -> list[Correction]:
    """Extend the first correction to earlier samples if none counts there: no step in time.

    first: of the first solved epoch. Not for a machine that states its own bias, which earlier samples had too.
    """
    knows = stated.get(first.from_ns // EPOCH_NS, NOTHING_STATED) != NOTHING_STATED
    counts_before = bool(counts) and counts[0].from_ns <= first.from_ns
    if first is not changed[0] or counts_before or knows or begins_ns >= first.from_ns:
        return []
    return [replace(first, from_ns=begins_ns, to_ns=first.from_ns)]


def _filled(counts: Sequence[Correction], changed: Sequence[Correction]) -> list[Correction]:
    """What counts, with scale and lateral bias that were unknown and are known now."""
    now, out = changed[-1], []
    known = now.most_share >= ANY_SHARE and state_of(now).beyond[1] <= FAULT_SIGMAS[1]
    for one in counts:
        zero, scale, across = (one.covariance[i][i] for i in range(3))
        filled = one
        if one.most_share == LEVEL_SHARE and known:
            scale = now.covariance[1][1]
            filled = replace(filled, scale=now.scale, most_share=now.most_share)
        if now.covariance[2][2] < TUNING.observed * across:
            across = now.covariance[2][2]
            filled = replace(filled, across=now.across)
        if filled is not one:
            out.append(replace(filled, covariance=((zero, 0.0, 0.0), (0.0, scale, 0.0), (0.0, 0.0, across))))
    return out


def _by_machine(corrections: Iterable[Correction]) -> dict[str, list[Correction]]:
    """A solve's corrections by machine and time, each up to the next."""
    out: dict[str, list[Correction]] = {}
    for one in corrections:
        out.setdefault(one.machine, []).append(one)
    for spans in out.values():
        ends = [*(after.from_ns for after in spans[1:]), LAST_NS]
        spans[:] = [replace(one, to_ns=end_ns) for one, end_ns in zip(spans, ends, strict=True)]
    return out


@dataclass
class _Epoch:
    """seen_ns: of the first solve; differs: successive differing solves."""

    seen_ns: int
    differs: int = 0


class Hysteresis:
    """Compares solves with what counts."""

    def __init__(self) -> None:
        self._epochs: dict[str, dict[int, _Epoch]] = {}  # by machine and beginning, from the last solve
        self._watched_ns = 0  # site time without jumps, since the first judgement
        self._judged_ns: int | None = None  # site time of the last judgement

    def watch(self, now_ns: int) -> None:
        """Note a solve's site time; nothing is learnt during jumps."""
        self._watched_ns += min(max(now_ns - (self._judged_ns or now_ns), 0), MOST_STEP_NS)
        self._judged_ns = now_ns

    def replacing(
        self,
        machine: str,
        proposed: Sequence[Correction],
        counts: Sequence[Correction],
        stated: Mapping[int, Stated],
        *,
        asked: bool,
    ) -> list[Correction]:
        """Corrections of a machine that replace what counts.

        proposed, counts: sorted. stated: by epoch, applied by the machine. asked: by a person, who gets every
        difference.
        """
        known, newest_ns = self._epochs.get(machine), proposed[-1].from_ns
        # after a restart, corrected epochs are as old as for their machine
        begins = known is None and len(counts) > 0
        own = self._epochs[machine] = {
            one.from_ns: (known or {}).get(one.from_ns)
            or _Epoch(self._watched_ns - (newest_ns - one.from_ns if begins else 0))
            for one in proposed
        }
        is_new = self._watched_ns < min(epoch.seen_ns for epoch in own.values()) + FIRST_NS
        needed = 1 if is_new and not counts else IN_A_ROW
        out = []
        for one in proposed:
            epoch, now = own[one.from_ns], at(counts, one.from_ns)
            applied = stated.get(one.from_ns // EPOCH_NS, NOTHING_STATED)
            epoch.differs = epoch.differs + 1 if differs(one, now, applied) else 0
            frozen = now is not None and self._watched_ns > epoch.seen_ns + FROZEN_NS
            wanted = (now is None or values(now) != values(one)) if asked else epoch.differs >= needed and not frozen
            if wanted:
                out.append(one)
        return out

    def differs_now(self, machine: str, from_ns: int) -> bool:
        """Whether the last solve differed from what counts at from_ns."""
        return self._epochs[machine][from_ns].differs > 0

    def decided(self, machine: str, corrections: Sequence[Correction]) -> None:
        """Reset the counts of decided epochs."""
        for from_ns, epoch in self._epochs.get(machine, {}).items():
            if any(one.from_ns <= from_ns < one.to_ns for one in corrections):
                epoch.differs = 0


def differs(one: Correction, counts: Correction | None, stated: Stated = NOTHING_STATED) -> bool:
    """Whether a correction differs by more than its standard deviation, and visibly.

    counts: None if samples stay as sent, with `stated` applied by the machine.
    """
    if counts:
        zero, scale, across = (abs(a - b) for a, b in zip(values(one)[:3], values(counts)[:3], strict=True))
    else:
        zero, across = math.hypot(one.zero - stated.zero, stated.zero_std), abs(one.across)
        scale = math.hypot(one.scale - stated.scale, stated.scale_std) if one.most_share >= ANY_SHARE else 0.0
    before = counts.rolls + counts.drags / TYPICAL_C_RR if counts else 0.0
    zero_std, scale_std, across_std = (math.sqrt(one.covariance[i][i]) for i in range(3))
    return (
        zero > max(zero_std, LEAST_ZERO)
        or scale > max(scale_std, LEAST_SCALE)
        or across > max(across_std, LEAST_ZERO)
        or abs(one.rolls + one.drags / TYPICAL_C_RR - before) > LEAST_ROLLS
        or (counts is not None and one.most_share != counts.most_share)
    )
