"""Which corrections count: decisions by the solver and by people, as journal events keep them.

What the solver says replaces what counts as `hysteresis` has it, of all machines at once and seldom, since a map that
follows has to be folded again. What a person decides about a machine stands until a person takes it back.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from mapserver.fleet.calibration import Calibration
from mapserver.fleet.correction import LAST_NS, UNCORRECTED, Correction, Corrections
from mapserver.fleet.hysteresis import Hysteresis
from mapserver.fleet.spans import VALUES, paint

KIND = "calibration"
VERSION = 1  # of the event; what a newer one means is not known here
SOLVER, PERSON = "solver", "person"
EVERY_NS = 600 * 10**9  # the solver decides at most so often: each time, samples are folded again


class NewerVersionError(ValueError):
    """A decision that this version cannot read."""

    def __init__(self, version: object) -> None:
        problem = f"a correction of a machine's samples of version {version!r}, by a newer version of this program"
        super().__init__(f"{problem}; this one knows version {VERSION}")


@dataclass(frozen=True)
class CalibrationDecision:
    """What was decided about the samples of a machine, as an event keeps it.

    by: the solver or a person. corrections: replace what the same one decided before of their spans; none of a person
    takes all back that people decided of this machine. stamp_ns: the site's now.
    """

    machine: str
    by: str
    reason: str
    stamp_ns: int
    corrections: tuple[Correction, ...]

    def body(self) -> dict[str, Any]:
        """Plain values."""
        spans = [
            [one.from_ns, one.to_ns, *(getattr(one, name) for name in VALUES), one.covariance]
            for one in self.corrections
        ]
        head = {"version": VERSION, "machine": self.machine, "by": self.by, "reason": self.reason}
        return {**head, "stamp_ns": self.stamp_ns, "spans": spans}

    @classmethod
    def from_body(cls, body: Mapping[str, Any]) -> CalibrationDecision:
        """Undo `body`; NewerVersionError where a newer version wrote it."""
        if body.get("version") != VERSION:
            raise NewerVersionError(body.get("version"))
        machine = body["machine"]
        corrections = tuple(
            Correction(machine, from_ns, to_ns, zero, scale, across, tuple(map(tuple, covariance)), most_share)
            for from_ns, to_ns, zero, scale, across, most_share, covariance in body["spans"]
        )
        return cls(machine, body["by"], body["reason"], body["stamp_ns"], corrections)


class CalibrationDecisions:
    """The corrections that count.

    decided_ns: the site's now when the solver decided last, None for never. confirmed: machines of whose newest samples
    the solver says what counts, in the last judgement.
    """

    def __init__(self, decisions: Iterable[CalibrationDecision] = ()) -> None:
        self._spans: dict[str, dict[str, list[Correction]]] = {SOLVER: {}, PERSON: {}}  # by machine, in order of time
        self._newest: dict[tuple[str, str], CalibrationDecision] = {}
        self._corrections = UNCORRECTED
        self._changed: set[str] = set()  # machines whose corrections are not the ones above any more
        self._hysteresis = Hysteresis()
        self._as_of_ns: dict[str, int] = {}  # the site's now when the solver last said so of the newest samples
        self.decided_ns: int | None = None
        self.confirmed: list[str] = []
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

    def newest(self, machine: str) -> CalibrationDecision | None:
        """The decision that a machine's newest correction comes from, None where it has none."""
        by = PERSON if self._spans[PERSON].get(machine) else SOLVER
        return self._newest.get((by, machine)) if self._spans[by].get(machine) else None

    def as_of_ns(self, machine: str) -> int:
        """The site's now when that what counts of a machine's newest samples was decided, or last confirmed."""
        by_person = self._newest[PERSON, machine] if self._spans[PERSON].get(machine) else None
        return by_person.stamp_ns if by_person else self._as_of_ns.get(machine, 0)

    def confirm(self, machines: Iterable[str], now_ns: int) -> None:
        """Note that the solver says of the newest samples of machines what counts already."""
        self._as_of_ns |= dict.fromkeys(machines, now_ns)

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
            self._hysteresis.decided(machine, decision.corrections)
            if any(one.to_ns == LAST_NS for one in decision.corrections):
                self.confirm([machine], decision.stamp_ns)
        self._changed.add(machine)

    def judge(self, calibration: Calibration, now_ns: int, *, asked: bool = False) -> list[CalibrationDecision]:
        """What the solver decides; the caller keeps it, then calls `add`.

        asked: by a person, who wants the best that is known: all that differs at all, whatever its age.
        """
        self._hysteresis.watch(now_ns)
        due = asked or self.decided_ns is None or not self.decided_ns <= now_ns < self.decided_ns + EVERY_NS
        decisions = []
        self.confirmed = []
        for machine, proposed in _by_machine(calibration.corrections).items():
            if self._spans[PERSON].get(machine):
                continue
            counts = self._spans[SOLVER].get(machine, [])
            stated = calibration.stated.get(machine, {})
            changed = self._hysteresis.replacing(machine, proposed, counts, stated, asked=asked)
            if counts and not self._hysteresis.differs_now(machine, proposed[-1].from_ns):
                self.confirmed.append(machine)
            if changed and due:
                changed = _from_the_beginning(changed, proposed, counts, calibration.begins_ns.get(machine, 0))
                decisions.append(CalibrationDecision(machine, SOLVER, "", now_ns, tuple(changed)))
        self.confirm(self.confirmed, now_ns)
        return decisions

    def _of(self, machine: str) -> list[Correction]:
        """Those of one machine: people's above the solver's."""
        spans = list(self._spans[SOLVER].get(machine, ()))
        for one in self._spans[PERSON].get(machine, ()):
            paint(spans, one)
        return spans


def _from_the_beginning(
    changed: Sequence[Correction], proposed: Sequence[Correction], counts: Sequence[Correction], begins_ns: int
) -> list[Correction]:
    """Where nothing counts before the first correction of a machine, it is that of all samples before: no step in time.

    begins_ns: of the machine's samples.
    """
    first = changed[0]
    if first is not proposed[0] or (counts and counts[0].from_ns <= first.from_ns):
        return list(changed)
    return [replace(first, from_ns=min(first.from_ns, begins_ns)), *changed[1:]]


def _by_machine(corrections: Iterable[Correction]) -> dict[str, list[Correction]]:
    """A solve's corrections by machine, in order of time, each up to the next one."""
    out: dict[str, list[Correction]] = {}
    for one in corrections:
        out.setdefault(one.machine, []).append(one)
    for spans in out.values():
        ends = [*(after.from_ns for after in spans[1:]), LAST_NS]
        spans[:] = [replace(one, to_ns=end_ns) for one, end_ns in zip(spans, ends, strict=True)]
    return out
