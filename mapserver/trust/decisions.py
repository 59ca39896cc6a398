"""Decisions which machines the map trusts, kept with reasons as journal events.

The newest decision counts. A person's stands until handed back to the audit. The audit waits for repeated verdicts, so
a doubtful machine does not flicker. To return, a machine must agree in all that it was excluded for; lack of
contradiction is not enough, because corrections reset all evidence. Only a person readmits a machine beyond its data
sheet: its corrected samples agree, but it is broken.
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
DISTRUST_AFTER, TRUST_AFTER = 2, 4  # successive verdicts needed


@dataclass(frozen=True)
class TrustDecision:
    """A decision about a machine, as in its event. by: audit or person; evidence: plain values."""

    machine: str
    trusted: bool
    by: str
    reason: str
    stamp_ns: int
    evidence: Mapping[str, Any] = field(default_factory=dict)


class TrustDecisions:
    """The newest decision about each machine."""

    def __init__(self, events: Iterable[Event]) -> None:
        self._newest = {event.body["machine"]: TrustDecision(**event.body) for event in events}
        self._in_a_row: dict[str, int] = {}

    @property
    def distrusted(self) -> frozenset[str]:
        """Machines excluded from the map."""
        return frozenset(name for name, decision in self._newest.items() if not decision.trusted)

    def newest(self, machine: str) -> TrustDecision | None:
        """The newest decision about a machine, or None."""
        return self._newest.get(machine)

    def add(self, decision: TrustDecision) -> None:
        """Make a decision the newest."""
        self._newest[decision.machine] = decision
        self._in_a_row.pop(decision.machine, None)

    def judge(self, verdicts: Mapping[str, Verdict], stamp_ns: int) -> list[TrustDecision]:
        """Decisions of the audit; the caller stores each, then calls `add`."""
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
    """Whether it agrees in all that it was excluded for; in anything, if the reason has no name."""
    words = decision.reason.split(", ") if decision else []
    named = {reason for reason in Reason if reason in words}
    return not verdict.contradicts and bool(verdict.agrees) and named <= verdict.agrees


def _stands(decision: TrustDecision) -> bool:
    """Whether the audit must leave it."""
    return decision.by == PERSON or (not decision.trusted and Reason.BEYOND_DATA_SHEET in decision.reason.split(", "))
