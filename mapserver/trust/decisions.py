"""Which machines the map trusts: decisions by the audit and by people, kept with their reasons as journal events.

A machine's newest decision counts. One made by a person stands until a person hands it back to the audit; the audit
waits for the same verdict several times, so that a doubtful machine does not go in and out. To come back, a machine has
to be seen to agree with the others in all that it was excluded for: that nothing contradicts it is not enough, since
after a correction all evidence is looked at anew. One beyond its data sheet comes back by a person alone: its corrected
samples agree, but something in it is broken.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from mapserver.journal.rows import Event
from mapserver.trust.auditor import Verdict
from mapserver.trust.judgement import Reason

KIND = "trust"
AUDIT, PERSON = "audit", "person"
DISTRUST_AFTER, TRUST_AFTER = 2, 4  # verdicts in a row


@dataclass(frozen=True)
class TrustDecision:
    """What was decided about a machine, as an event keeps it. by: the audit or a person; evidence: plain values."""

    machine: str
    trusted: bool
    by: str
    reason: str
    stamp_ns: int
    evidence: Mapping[str, Any] = field(default_factory=dict)


class TrustDecisions:
    """Newest decision about each machine."""

    def __init__(self, events: Iterable[Event]) -> None:
        self._newest = {event.body["machine"]: TrustDecision(**event.body) for event in events}
        self._in_a_row: dict[str, int] = {}

    @property
    def distrusted(self) -> frozenset[str]:
        """Machines whose rows are excluded from the map."""
        return frozenset(name for name, decision in self._newest.items() if not decision.trusted)

    def newest(self, machine: str) -> TrustDecision | None:
        """The newest decision about a machine, None where there never was one."""
        return self._newest.get(machine)

    def add(self, decision: TrustDecision) -> None:
        """Make a decision the newest one about its machine."""
        self._newest[decision.machine] = decision
        self._in_a_row.pop(decision.machine, None)

    def judge(self, verdicts: Mapping[str, Verdict], stamp_ns: int) -> list[TrustDecision]:
        """What the audit decides on these verdicts; the caller keeps it, then calls `add`."""
        decisions = (self._judge(verdict, stamp_ns) for verdict in verdicts.values())
        return [decision for decision in decisions if decision]

    def _judge(self, verdict: Verdict, stamp_ns: int) -> TrustDecision | None:
        machine, now = verdict.machine, self._newest.get(verdict.machine)
        trusted = now is None or now.trusted
        if (now and _stands(now)) or not (verdict.contradicts if trusted else _agrees(verdict, now)):
            self._in_a_row.pop(machine, None)
            return None
        self._in_a_row[machine] = self._in_a_row.get(machine, 0) + 1
        if self._in_a_row[machine] < (DISTRUST_AFTER if trusted else TRUST_AFTER):
            return None
        reason = ", ".join(verdict.reasons) if trusted else "agrees with the others again"
        return TrustDecision(machine, not trusted, AUDIT, reason, stamp_ns, dict(verdict.evidence))


def _agrees(verdict: Verdict, decision: TrustDecision | None) -> bool:
    """Whether a machine is seen to agree in what it was excluded for; in anything at all, where that has no name."""
    words = decision.reason.split(", ") if decision else []
    named = {reason for reason in Reason if reason in words}
    return not verdict.contradicts and bool(verdict.agrees) and named <= verdict.agrees


def _stands(decision: TrustDecision) -> bool:
    """Whether the audit leaves a decision alone."""
    return decision.by == PERSON or (not decision.trusted and Reason.BEYOND_DATA_SHEET in decision.reason.split(", "))
