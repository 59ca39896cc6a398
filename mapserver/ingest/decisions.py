"""A store's decisions on trust and calibration, and their facts."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict
from typing import Any

from mapserver.calibration.correction import LAST_NS, NO_SHARE
from mapserver.calibration.decide import CalibrationDecisions
from mapserver.calibration.decision import KIND as CALIBRATION
from mapserver.calibration.decision import CalibrationDecision
from mapserver.journal.facts import Facts
from mapserver.journal.journal import JournalQueries
from mapserver.journal.rows import Event
from mapserver.trust import decisions as trust
from mapserver.trust.decisions import TrustDecision, TrustDecisions
from protocol.errors import StoreError
from protocol.wire.codec import encode_offer
from protocol.wire.messages import CalibrationOffer

Decision = TrustDecision | CalibrationDecision
KINDS = (trust.KIND, CALIBRATION)


class Decisions:
    """Decisions of both kinds. facts: their result."""

    def __init__(self) -> None:
        self.trust, self.calibration = TrustDecisions(()), CalibrationDecisions()
        self.facts = Facts()

    @classmethod
    def of_journal(cls, journal: JournalQueries) -> Decisions:
        """A journal's decisions; StoreError if another program wrote one."""
        decisions = cls()
        decisions.hear(journal.events(), journal.where)
        return decisions

    def hear(self, events: Iterable[Event], where: str) -> None:
        """Apply decisions among further events; StoreError as `of_journal`."""
        number = self.facts.number
        for event in events:
            if event.kind in KINDS:
                self._take(_decision(event, where))
                number = event.id
        self._conclude(number)

    def add(self, decisions: Iterable[Decision], number: int) -> None:
        """Apply further decisions. number: of the last one's event."""
        for decision in decisions:
            self._take(decision)
        self._conclude(number)

    def offer(self, machine: str) -> dict[str, Any] | None:
        """A calibration for a machine to adopt, as acknowledgements have it, or None.

        It is its newest correction, dated by the solver's last confirmation: machines adopt no old one.
        """
        newest = self.facts.corrections.newest(machine)
        if not newest or newest.to_ns < LAST_NS or not newest.covariance:
            return None
        if newest.most_share == NO_SHARE:  # no calibration of a sensor that measures nothing
            return None
        (zz, zs, _), (_, ss, _), _ = newest.covariance
        as_of_ns = self.calibration.as_of_ns(machine)
        return encode_offer(CalibrationOffer(machine, as_of_ns, newest.zero, newest.scale, zz, ss, zs))

    def _take(self, decision: Decision) -> None:
        if isinstance(decision, CalibrationDecision):
            self.calibration.add(decision)
        else:
            self.trust.add(decision)

    def _conclude(self, number: int) -> None:
        excluded, corrections = self.trust.distrusted, self.calibration.corrections
        if excluded:  # corrections of excluded samples change no map
            corrections = corrections.without(excluded)
        self.facts = Facts(excluded, corrections, number)


def calibrations(journal: JournalQueries) -> list[CalibrationDecision]:
    """A journal's calibration decisions, in order; StoreError as `Decisions.of_journal`."""
    decisions = (_decision(event, journal.where) for event in journal.events(CALIBRATION))
    return [decision for decision in decisions if isinstance(decision, CalibrationDecision)]


def plain(decision: Decision) -> tuple[str, int, Mapping[str, Any]]:
    """Kind, stamp and body of a decision's event."""
    if isinstance(decision, CalibrationDecision):
        return CALIBRATION, decision.stamp_ns, decision.body()
    return trust.KIND, decision.stamp_ns, asdict(decision)


def _decision(event: Event, where: str) -> Decision:
    try:
        return TrustDecision(**event.body) if event.kind == trust.KIND else CalibrationDecision.from_body(event.body)
    except (ValueError, TypeError, LookupError) as error:
        problem = f"event {event.id} is of another program ({error}); open the store with that one"
        raise StoreError(where, problem) from None
