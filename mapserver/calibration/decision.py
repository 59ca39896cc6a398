"""A decision about a machine's calibration: in the journal, by people, in answers."""

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

KIND = "calibration"  # event kind
SOLVER, PERSON = "solver", "person"
MOST_SPANS = 100  # spans per answer: a machine's last day


@dataclass(frozen=True)
class CalibrationDecision:
    """A decision about a machine, as in its event.

    by: solver or person. corrections: replace the same author's in their spans; none of a person withdraws all.
    stamp_ns: site time. remembered: the scale is from earlier evidence.
    """

    machine: str
    by: str
    reason: str
    stamp_ns: int
    corrections: tuple[Correction, ...]
    remembered: bool = False

    def body(self) -> dict[str, Any]:
        """As plain values."""
        spans = [_span(one) for one in self.corrections]
        head = {"machine": self.machine, "by": self.by, "reason": self.reason, "stamp_ns": self.stamp_ns}
        return {**head, "remembered": self.remembered, "spans": spans}

    @classmethod
    def from_body(cls, body: Mapping[str, Any]) -> CalibrationDecision:
        """Inverse of `body`; ValueError, TypeError or LookupError for foreign content."""
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
    """A machine's calibration. decision: its newest; state: of the last solve; corrections: of the map."""
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
    """A person's decision about all samples. stamp_ns: site time."""
    given = {name: round(value, DIGITS) for name, value in command.values.items()}
    usual = {"zero": 0.0, "scale": 0.0, "across": 0.0, "most_share": ANY_SHARE}
    whole = Correction(command.machine, 0, LAST_NS, covariance=(), **{**usual, **given})
    corrections = () if command.auto else (whole,)
    return CalibrationDecision(command.machine, PERSON, command.reason, stamp_ns, corrections)


def _span(one: Correction) -> list[Any]:
    """A correction in plain values; rolls and drags stand last, if not 0."""
    *first, rolls, drags = values(one)
    rolling = [rolls, drags] if rolls or drags else []
    return [one.from_ns, one.to_ns, *first, one.covariance, *rolling]
