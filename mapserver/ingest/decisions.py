"""A store's decisions on trust, calibration and repairs of roads, and their facts."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

from mapserver.calibration.correction import LAST_NS, NO_SHARE
from mapserver.calibration.decide import CalibrationDecisions
from mapserver.calibration.decision import KIND as CALIBRATION
from mapserver.calibration.decision import CalibrationDecision
from mapserver.journal.facts import Facts
from mapserver.journal.journal import JournalQueries
from mapserver.journal.rows import Event
from mapserver.roads.repair_facts import KIND as REPAIR
from mapserver.roads.repair_facts import NO_REPAIRS, RoadRepair
from mapserver.trust import decisions as trust
from mapserver.trust.decisions import TrustDecision, TrustDecisions
from protocol.errors import StoreError
from protocol.wire.codec import encode_offer
from protocol.wire.messages import CalibrationOffer

GroundDecision = CalibrationDecision | RoadRepair  # about samples and roads, as archives have them
MachineDecision = TrustDecision | CalibrationDecision
Decision = MachineDecision | RoadRepair
DECODERS: dict[str, Callable[[Any], Decision]] = {
    trust.KIND: lambda body: TrustDecision(**body),
    CALIBRATION: CalibrationDecision.from_body,
    REPAIR: RoadRepair.from_body,
}


class Decisions:
    """Decisions of all kinds. facts: their result."""

    def __init__(self, cell_m: float | None = None) -> None:
        """cell_m: of the map; repairs of roads on other cells do not count, so the search finds them again."""
        self._cell_m = cell_m
        self.trust, self.calibration, self._repairs = TrustDecisions(()), CalibrationDecisions(), NO_REPAIRS
        self.facts = Facts()

    @classmethod
    def of_journal(cls, journal: JournalQueries, cell_m: float | None = None) -> Decisions:
        """A journal's decisions; StoreError if another program wrote one."""
        decisions = cls(cell_m)
        decisions.hear(journal.events(), journal.where)
        return decisions

    def hear(self, events: Iterable[Event], where: str) -> None:
        """Apply decisions among further events; StoreError as `of_journal`."""
        decided = [event for event in events if event.kind in DECODERS]
        self.add([_decision(event, where) for event in decided], decided[-1].id if decided else self.facts.number)

    def add(self, decisions: Sequence[Decision], number: int) -> None:
        """Apply further decisions. number: of the last one's event."""
        for decision in decisions:
            if isinstance(decision, CalibrationDecision):
                self.calibration.add(decision)
            elif isinstance(decision, TrustDecision):
                self.trust.add(decision)
        repairs = [decision for decision in decisions if isinstance(decision, RoadRepair)]
        if repairs := [repair for repair in repairs if repair.cell_m == self._cell_m]:
            self._repairs = self._repairs.after(repairs)
        excluded, corrections = self.trust.distrusted, self.calibration.corrections
        if excluded:  # corrections of excluded samples change no map
            corrections = corrections.without(excluded)
        self.facts = Facts(excluded, corrections, number, self._repairs)

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


def ground_decisions(journal: JournalQueries) -> list[GroundDecision]:
    """A journal's decisions about samples and roads, in order; StoreError as `Decisions.of_journal`."""
    decisions = (_decision(event, journal.where) for event in journal.events() if event.kind in DECODERS)
    return [decision for decision in decisions if not isinstance(decision, TrustDecision)]


def plain(decision: Decision) -> tuple[str, int, Mapping[str, Any]]:
    """Kind, stamp and body of a decision's event."""
    if isinstance(decision, TrustDecision):
        return trust.KIND, decision.stamp_ns, asdict(decision)
    return CALIBRATION if isinstance(decision, CalibrationDecision) else REPAIR, decision.stamp_ns, decision.body()


def _decision(event: Event, where: str) -> Decision:
    try:
        return DECODERS[event.kind](event.body)
    except (ValueError, TypeError, LookupError) as error:
        problem = f"event {event.id} is of another program ({error}); open the store with that one"
        raise StoreError(where, problem) from None
