"""A decision about a machine's calibration: as the journal keeps it, a person makes it, and an answer tells it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import chain
from typing import Any

from mapserver.calibration.correction import ANY_SHARE, DIGITS, LAST_NS, Correction, SampleCorrections, values
from mapserver.calibration.select import MachineErrors
from protocol.queries.calibration import CorrectedSpan, MachineCalibration
from protocol.queries.commands import CalibrateCommand

KIND = "calibration"  # of the event
SOLVER, PERSON = "solver", "person"
MOST_SPANS = 100  # of an answer: the last day of a machine at work


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
        head = {"machine": self.machine, "by": self.by, "reason": self.reason, "stamp_ns": self.stamp_ns}
        return {**head, "remembered": self.remembered, "spans": spans}

    @classmethod
    def from_body(cls, body: Mapping[str, Any]) -> CalibrationDecision:
        """Undo `body`; ValueError, TypeError or LookupError for what no program of this kind wrote."""
        machine = body["machine"]
        corrections = tuple(
            Correction(machine, from_ns, to_ns, zero, scale, across, tuple(map(tuple, covariance)), most_share, *rolls)
            for from_ns, to_ns, zero, scale, across, most_share, covariance, *rolls in body["spans"]
        )
        numbers = chain(*((*values(one), *chain(*one.covariance)) for one in corrections))
        if not all(map(math.isfinite, numbers)) or any(one.rolls <= -1 for one in corrections):
            raise ValueError(f"has a correction of {machine} that no solver made")
        return cls(machine, body["by"], body["reason"], body["stamp_ns"], corrections, body["remembered"])


def calibration_of(
    machine: str, decision: CalibrationDecision | None, state: MachineErrors | None, corrections: SampleCorrections
) -> MachineCalibration:
    """What is known of a machine.

    decision: its newest one. state: of the last solve. corrections: those that count in the map.
    """
    spans = corrections.spans_of(machine)[-MOST_SPANS:]
    return MachineCalibration(
        name=machine,
        by=decision.by if decision else "",
        reason=decision.reason if decision else "",
        since_ns=decision.stamp_ns if decision else 0,
        zero=state.zero if state else None,
        zero_std=state.zero_std if state else None,
        scale=state.scale / (1 + state.scale) if state else None,
        scale_std=state.scale_std / (1 + state.scale) ** 2 if state else None,
        across=state.across if state else None,
        across_std=state.across_std if state else None,
        zero_by=state.zero_by if state else (),
        scale_by=state.scale_by if state else (),
        spans=tuple(
            CorrectedSpan(one.from_ns, one.to_ns, one.zero, one.scale, one.across, one.most_share) for one in spans
        ),
    )


def decided_by_person(command: CalibrateCommand, stamp_ns: int) -> CalibrationDecision:
    """What a person decides about all samples of a machine. stamp_ns: the site's now."""
    given = {name: round(value, DIGITS) for name, value in command.values.items()}
    usual = {"zero": 0.0, "scale": 0.0, "across": 0.0, "most_share": ANY_SHARE}
    whole = Correction(command.machine, 0, LAST_NS, covariance=(), **{**usual, **given})
    corrections = () if command.auto else (whole,)
    return CalibrationDecision(command.machine, PERSON, command.reason, stamp_ns, corrections)


def _span(one: Correction) -> list[Any]:
    """One correction; how its machine rolls stands last, where it rolls unlike the others."""
    *first, rolls, drags = values(one)
    rolling = [rolls, drags] if rolls or drags else []
    return [one.from_ns, one.to_ns, *first, one.covariance, *rolling]
