"""The calibration of one machine between what is decided, what is solved, and what people ask and say."""

from __future__ import annotations

from mapserver.fleet.correction import ANY_SHARE, DIGITS, LAST_NS, Correction, Corrections
from mapserver.fleet.decisions import PERSON, CalibrationDecision
from mapserver.fleet.machine_state import MachineState
from protocol.queries.calibration import CorrectedSpan, MachineCalibration
from protocol.queries.commands import CalibrateCommand

MOST_SPANS = 100  # of an answer: the last day of a machine at work


def calibration_of(
    machine: str, decision: CalibrationDecision | None, state: MachineState | None, corrections: Corrections
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
    values = {name: round(value, DIGITS) for name, value in command.values.items()}
    usual = {"zero": 0.0, "scale": 0.0, "across": 0.0, "most_share": ANY_SHARE}
    whole = Correction(command.machine, 0, LAST_NS, covariance=(), **{**usual, **values})
    corrections = () if command.auto else (whole,)
    return CalibrationDecision(command.machine, PERSON, command.reason, stamp_ns, corrections)
