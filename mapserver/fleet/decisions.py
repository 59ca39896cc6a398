"""Which corrections count: decisions by the solver and by people, as journal events keep them.

What the solver says replaces what counts as `hysteresis` has it, of all machines at once and seldom, since a map that
follows has to be folded again. What a person decides about a machine stands until a person takes it back.

A machine has one scale and one lateral zero: what is known of them late is known of all its samples, and repaints
those of which nobody knew. A zero is that of its epoch.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any

from mapserver.fleet.calibration import Calibration
from mapserver.fleet.correction import (
    ANY_SHARE,
    LAST_NS,
    LEVEL_SHARE,
    UNCORRECTED,
    Correction,
    Corrections,
    paint,
    values,
)
from mapserver.fleet.hysteresis import Hysteresis
from mapserver.fleet.ledger import EPOCH_NS, NOTHING_STATED, Stated
from mapserver.fleet.observability import FAULT_SIGMAS, OBSERVED, state_of

KIND = "calibration"
VERSION = 1  # of the event
SOLVER, PERSON = "solver", "person"
# The solver decides at most so often: each time, samples are folded again. In the first minutes of machines, when it
# learns most and there is little to fold, as soon as they have driven twice as long as at the last decision.
EVERY_NS = 600 * 10**9


@dataclass(frozen=True)
class CalibrationDecision:
    """What was decided about the samples of a machine, as an event keeps it.

    by: the solver or a person. corrections: each replaces what the same one decided before of its span; none of a
    person takes all back that people decided of this machine. stamp_ns: the site's now. remembered: the scale is one
    that was shown earlier, not by the evidence of now.
    """

    machine: str
    by: str
    reason: str
    stamp_ns: int
    corrections: tuple[Correction, ...]
    remembered: bool = False

    def body(self) -> dict[str, Any]:
        """Plain values."""
        spans = [_span(one) for one in self.corrections]
        head = {"version": VERSION, "machine": self.machine, "by": self.by, "reason": self.reason}
        return {**head, "stamp_ns": self.stamp_ns, "remembered": self.remembered, "spans": spans}

    @classmethod
    def from_body(cls, body: Mapping[str, Any]) -> CalibrationDecision:
        """Undo `body`; ValueError where it is of another version."""
        if body.get("version") != VERSION:
            raise ValueError(f"has a correction of version {body.get('version')!r}, this program knows {VERSION}")
        machine = body["machine"]
        corrections = tuple(
            Correction(machine, from_ns, to_ns, zero, scale, across, tuple(map(tuple, covariance)), most_share, *rolls)
            for from_ns, to_ns, zero, scale, across, most_share, covariance, *rolls in body["spans"]
        )
        numbers = chain(*((*values(one), *chain(*one.covariance)) for one in corrections))
        if not all(map(math.isfinite, numbers)) or any(one.rolls <= -1 for one in corrections):
            raise ValueError(f"has a correction of {machine} that no solver made")
        return cls(machine, body["by"], body["reason"], body["stamp_ns"], corrections, body["remembered"])


class CalibrationDecisions:
    """The corrections that count.

    decided_ns: the site's now when the solver decided last, None for never. confirmed: machines of whose newest samples
    the solver says what counts, in the last judgement, and as of when [ns].
    """

    def __init__(self, decisions: Iterable[CalibrationDecision] = ()) -> None:
        self._spans: dict[str, dict[str, list[Correction]]] = {SOLVER: {}, PERSON: {}}  # by machine, in order of time
        self._newest: dict[tuple[str, str], CalibrationDecision] = {}
        self._corrections = UNCORRECTED
        self._changed: set[str] = set()  # machines whose corrections are not the ones above any more
        self._hysteresis = Hysteresis()
        self._waiting: dict[str, CalibrationDecision] = {}  # by machine, what the solver wants until it may decide
        self._shown: dict[str, Correction] = {}  # by machine, the last one whose scale evidence showed
        self._as_of_ns: dict[str, int] = {}  # see `as_of_ns`, of what the solver says
        self.decided_ns: int | None = None
        self.confirmed: Mapping[str, int] = {}
        for decision in decisions:
            self.add(decision)

    @property
    def corrections(self) -> Corrections:
        """All that count."""
        if self._changed:
            self._corrections = self._corrections.replaced({name: self._of(name) for name in self._changed})
            self._changed.clear()
        return self._corrections

    def of_solver(self) -> list[Correction]:
        """The newest correction of each machine that the solver decided, whatever people did."""
        return [spans[-1] for spans in self._spans[SOLVER].values() if spans]

    def shown(self) -> list[Correction]:
        """The last correction of each machine whose scale evidence showed, whatever was decided since."""
        return list(self._shown.values())

    def newest(self, machine: str) -> CalibrationDecision | None:
        """The decision that a machine's newest correction comes from, None where it has none."""
        by = PERSON if self._spans[PERSON].get(machine) else SOLVER
        return self._newest.get((by, machine)) if self._spans[by].get(machine) else None

    def as_of_ns(self, machine: str) -> int:
        """As of when that counts what is taken off a machine's newest samples.

        The site's now when it was decided or last confirmed; but of a machine that stands, the end of its last epoch.
        """
        by_person = self._newest[PERSON, machine] if self._spans[PERSON].get(machine) else None
        return by_person.stamp_ns if by_person else self._as_of_ns.get(machine, 0)

    def confirm(self, confirmed: Mapping[str, int]) -> None:
        """Note that the solver says of the newest samples of machines what counts already, as of when [ns]."""
        self._as_of_ns |= confirmed

    def add(self, decision: CalibrationDecision) -> None:
        """Have a decision count."""
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

    def judge(self, calibration: Calibration, now_ns: int, *, asked: bool = False) -> list[CalibrationDecision]:
        """What the solver decides; the caller keeps it, then calls `add`, or the same waits for the next judgement.

        calibration: of some machines; what is wanted of others waits as well. asked: by a person, who wants the best
        that is known: all that differs at all, whatever its age.
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

    def _due_ns(self, calibration: Calibration, now_ns: int) -> int:
        """The site's now from which on the solver may decide again what it says of some machines."""
        assert self.decided_ns is not None
        first_ns = min(calibration.begins_ns.values(), default=0)
        driven_ns = max(0, self.decided_ns - first_ns) if first_ns <= now_ns else EVERY_NS  # else a clock is ahead
        return self.decided_ns + min(driven_ns, EVERY_NS)

    def _of(self, machine: str) -> list[Correction]:
        """Those of one machine: people's above the solver's."""
        spans = list(self._spans[SOLVER].get(machine, ()))
        for one in self._spans[PERSON].get(machine, ()):
            paint(spans, one)
        return spans


def _span(one: Correction) -> list[Any]:
    """One correction; how its machine rolls stands last, where it rolls unlike the others."""
    *first, rolls, drags = values(one)
    rolling = [rolls, drags] if rolls or drags else []
    return [one.from_ns, one.to_ns, *first, one.covariance, *rolling]


def _as_of_ns(newest: Correction, now_ns: int) -> int:
    """As of when a solver's newest correction of a machine says what it says: a machine that stands shows nothing."""
    return min(now_ns, newest.from_ns + EPOCH_NS)


def _before(
    first: Correction,
    changed: Sequence[Correction],
    counts: Sequence[Correction],
    stated: Mapping[int, Stated],
    begins_ns: int,
) -> list[Correction]:
    """Where nothing counts before the first correction of a machine, it is that of all samples before: no step in time.

    first: epoch that was solved for. begins_ns: of the machine's samples. But of a machine that states a zero of its
    own, samples before were sent with that of then.
    """
    knows = stated.get(first.from_ns // EPOCH_NS, NOTHING_STATED) != NOTHING_STATED
    counts_before = bool(counts) and counts[0].from_ns <= first.from_ns
    if first is not changed[0] or counts_before or knows or begins_ns >= first.from_ns:
        return []
    return [replace(first, from_ns=begins_ns, to_ns=first.from_ns)]


def _filled(counts: Sequence[Correction], changed: Sequence[Correction]) -> list[Correction]:
    """What counts, with what was not known then of the scale and the lateral zero, and is now; zeros stay.

    What evidence showed then stays, too: where a machine was mended since, it was right then. Nor was a fault always
    there.
    """
    now, out = changed[-1], []
    known = now.most_share >= ANY_SHARE and state_of(now).beyond[1] <= FAULT_SIGMAS[1]
    for one in counts:
        zero, scale, across = (one.covariance[i][i] for i in range(3))
        filled = one
        if one.most_share == LEVEL_SHARE and known:
            scale = now.covariance[1][1]
            filled = replace(filled, scale=now.scale, most_share=now.most_share)
        if now.covariance[2][2] < OBSERVED * across:
            across = now.covariance[2][2]
            filled = replace(filled, across=now.across)
        if filled is not one:
            out.append(replace(filled, covariance=((zero, 0.0, 0.0), (0.0, scale, 0.0), (0.0, 0.0, across))))
    return out


def _by_machine(corrections: Iterable[Correction]) -> dict[str, list[Correction]]:
    """A solve's corrections by machine, in order of time, each up to the next one."""
    out: dict[str, list[Correction]] = {}
    for one in corrections:
        out.setdefault(one.machine, []).append(one)
    for spans in out.values():
        ends = [*(after.from_ns for after in spans[1:]), LAST_NS]
        spans[:] = [replace(one, to_ns=end_ns) for one, end_ns in zip(spans, ends, strict=True)]
    return out
