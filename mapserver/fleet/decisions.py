"""Which corrections count: decisions by the solver and by people, as journal events keep them.

What the solver says changes with every sample, and a map that follows has to be folded again. So a correction is
replaced only where it is off by more than it is unsure, twice in a row, and what is old is left alone. All times are
site time. What a person decides about a machine stands until a person takes it back.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from mapserver.fleet.calibration import Calibration
from mapserver.fleet.correction import ANY_SHARE, LAST_NS, Correction, Corrections

KIND = "calibration"
VERSION = 1  # of the event; what a newer one means is not known here
SOLVER, PERSON = "solver", "person"
IN_A_ROW = 2  # solves that have to differ from what counts
LEAST_ZERO, LEAST_SCALE = 0.0005, 0.005  # by less than this no map gets better
EVERY_NS = 600 * 10**9  # the solver decides at most so often: each time, samples are folded again
FROZEN_NS = 4 * 3600 * 10**9  # so long after it was first seen, an epoch keeps its correction
_VALUES = ("zero", "scale", "across", "most_share")


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
            [one.from_ns, one.to_ns, *(getattr(one, name) for name in _VALUES), one.covariance]
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
    """The corrections that count. decided_ns: the site's now when the solver decided last, None for never."""

    def __init__(self, decisions: Iterable[CalibrationDecision] = ()) -> None:
        self._spans: dict[str, dict[str, list[Correction]]] = {SOLVER: {}, PERSON: {}}  # by machine, in order of time
        self._newest: dict[tuple[str, str], CalibrationDecision] = {}
        self._corrections: Corrections | None = None
        self._seen: dict[tuple[str, int], int] = {}  # when an epoch was first solved for, as _watched_ns counts
        self._watched_ns = 0  # site time without its jumps, since the first judgement
        self._judged_ns: int | None = None  # the site's now in the last one
        self._differs: dict[tuple[str, int], int] = {}  # how often in a row
        self.decided_ns: int | None = None
        for decision in decisions:
            self.add(decision)

    @property
    def corrections(self) -> Corrections:
        """All that count."""
        if self._corrections is None:
            self._corrections = Corrections(
                one for name in {*self._spans[SOLVER], *self._spans[PERSON]} for one in self._of(name)
            )
        return self._corrections

    def of_solver(self) -> dict[str, Correction]:
        """The newest correction of each machine that the solver decided, whatever people did."""
        return {machine: spans[-1] for machine, spans in self._spans[SOLVER].items() if spans}

    def newest(self, machine: str) -> CalibrationDecision | None:
        """The decision that a machine's newest correction comes from, None where it has none."""
        by = PERSON if self._spans[PERSON].get(machine) else SOLVER
        return self._newest.get((by, machine)) if self._spans[by].get(machine) else None

    def add(self, decision: CalibrationDecision) -> None:
        """Have a decision count."""
        spans = self._spans[decision.by].setdefault(decision.machine, [])
        if not decision.corrections:
            spans.clear()
        for one in decision.corrections:
            paint(spans, one)
            self._differs.pop((one.machine, one.from_ns), None)
        self._newest[decision.by, decision.machine] = decision
        if decision.by == SOLVER:
            self.decided_ns = decision.stamp_ns
        self._corrections = None

    def judge(self, calibration: Calibration, now_ns: int, *, asked: bool = False) -> list[CalibrationDecision]:
        """What the solver decides; the caller keeps it, then calls `add`.

        asked: by a person, who wants the best that is known: all that differs at all, whatever its age.
        """
        proposed = _by_machine(calibration.corrections)
        self._see(proposed, now_ns)
        due = asked or self.decided_ns is None or not self.decided_ns <= now_ns < self.decided_ns + EVERY_NS
        decisions = []
        for machine, spans in proposed.items():
            if self._spans[PERSON].get(machine):
                continue
            changed = [one for one in spans if asked or not self._is_frozen(one)]
            changed = [one for one in changed if self._replaces(one, asked=asked)]
            if changed and due:
                decisions.append(CalibrationDecision(machine, SOLVER, "", now_ns, tuple(changed)))
        return decisions

    def _of(self, machine: str) -> list[Correction]:
        """Those of one machine: people's above the solver's."""
        spans = list(self._spans[SOLVER].get(machine, ()))
        for one in self._spans[PERSON].get(machine, ()):
            paint(spans, one)
        return spans

    def _see(self, proposed: Mapping[str, Sequence[Correction]], now_ns: int) -> None:
        """Note when epochs are first seen; those that a server begins with are as old as they are for their machine.

        Site time may jump, where a clock is wrong or at night. In what was jumped over nobody learned anything.
        """
        begins = self._judged_ns is None
        self._watched_ns += min(max(now_ns - (self._judged_ns or now_ns), 0), EVERY_NS)
        self._judged_ns = now_ns
        self._seen = {
            (machine, one.from_ns): self._seen.get(
                (machine, one.from_ns), self._watched_ns - begins * (spans[-1].from_ns - one.from_ns)
            )
            for machine, spans in proposed.items()
            for one in spans
        }

    def _is_frozen(self, one: Correction) -> bool:
        counts = at(self._spans[SOLVER].get(one.machine, []), one.from_ns)
        return counts is not None and self._watched_ns > self._seen[one.machine, one.from_ns] + FROZEN_NS

    def _replaces(self, one: Correction, *, asked: bool) -> bool:
        """Whether a correction is to replace what counts at its beginning."""
        counts = at(self._spans[SOLVER].get(one.machine, []), one.from_ns)
        key = one.machine, one.from_ns
        if asked:
            return counts is None or _values(counts) != _values(one)
        self._differs[key] = self._differs.get(key, 0) + 1 if differs(one, counts) else 0
        return self._differs[key] >= IN_A_ROW


def paint(spans: list[Correction], one: Correction) -> None:
    """Put a correction over those of one machine, which are in order of time; what it covers of them goes."""
    first = bisect_right(spans, one.from_ns, key=lambda other: other.to_ns)
    end = first
    while end < len(spans) and spans[end].from_ns < one.to_ns:
        end += 1
    left = [replace(other, to_ns=one.from_ns) for other in spans[first:end] if other.from_ns < one.from_ns]
    right = [replace(other, from_ns=one.to_ns) for other in spans[first:end] if other.to_ns > one.to_ns]
    spans[first:end] = [*left, one, *right]


def at(spans: Sequence[Correction], stamp_ns: int) -> Correction | None:
    """The correction that a time has, of those of one machine in order of time."""
    index = bisect_right(spans, stamp_ns, key=lambda one: one.from_ns) - 1
    return spans[index] if index >= 0 and stamp_ns < spans[index].to_ns else None


def differs(one: Correction, counts: Correction | None) -> bool:
    """Whether a correction differs from what counts by more than it is unsure, and by enough to be seen."""
    zero, scale, across, most_share = _values(counts) if counts else (0.0, 0.0, 0.0, ANY_SHARE)
    zero_std, scale_std, across_std = (math.sqrt(one.covariance[i][i]) for i in range(3))
    return (
        abs(one.zero - zero) > max(zero_std, LEAST_ZERO)
        or abs(one.scale - scale) > max(scale_std, LEAST_SCALE)
        or abs(one.across - across) > max(across_std, LEAST_ZERO)
        or (counts is not None and one.most_share != most_share)
    )


def _values(one: Correction) -> tuple[float, ...]:
    return tuple(getattr(one, name) for name in _VALUES)


def _by_machine(corrections: Iterable[Correction]) -> dict[str, list[Correction]]:
    """A solve's corrections by machine, in order of time, each up to the next one."""
    out: dict[str, list[Correction]] = {}
    for one in corrections:
        out.setdefault(one.machine, []).append(one)
    for spans in out.values():
        ends = [*(after.from_ns for after in spans[1:]), LAST_NS]
        spans[:] = [replace(one, to_ns=end_ns) for one, end_ns in zip(spans, ends, strict=True)]
    return out
