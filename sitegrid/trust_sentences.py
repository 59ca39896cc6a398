"""Trust and calibration of machines in words for people."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

from protocol.queries.answers import MachineState

TORQUE_OFF, SURE = 0.05, 3.0  # torque gain error beyond data sheets; in standard deviations
MOST_LISTED = 12  # machines beside a picture


def why(machine: MachineState) -> str:
    """Contradictions to other machines or to its data sheet, and decisions; empty if none."""
    said = [*(_sentence(reason, machine.evidence) for reason in machine.reasons), pulls(machine), rolls(machine)]
    if machine.reason != ", ".join(machine.reasons):
        said.append(machine.reason)
    return "; ".join(filter(None, said))


def pulls(machine: MachineState) -> str:
    """Error of the drive force against the ground and its possible causes; empty if insignificant."""
    known = machine.evidence
    with suppress(KeyError, TypeError, ValueError):
        off, std, is_known = known["torque_gain"] - 1, known["torque_gain_std"], known["torque_gain_by"]
        if is_known and abs(off) > max(TORQUE_OFF, SURE * std):
            how = f"{100 * abs(off):.0f} +- {100 * std:.0f} % {'high' if off > 0 else 'low'}"
            return f"torque looks {how}: reference torque of its engine, its sensor, or its mass"
    return ""


def rolls(machine: MachineState) -> str:
    """Difference in rolling resistance from the other machines, causes and cost; empty if insignificant.

    If most machines are wrong alike, the odd one is right; nothing shows that.
    """
    known = machine.evidence
    with suppress(KeyError, TypeError, ValueError):
        share, than = known["rolls"], "the others" if known["rolls_named"] else "some others, or these than it,"
        how = f"{100 * abs(share):.0f} +- {100 * known['rolls_std']:.0f} % {'harder' if share > 0 else 'easier'}"
        costs = f"; costs about {known['rolls_litres_ph']:.2g} l/h" if known.get("rolls_litres_ph", 0.0) > 0 else ""
        return f"rolls {how} than {than} on the same ground: tyre pressure, brake, torque scale{costs}"
    return ""


def _sentence(reason: str, evidence: Mapping[str, Any]) -> str:
    """A reason with its figures; only its name if the server is newer."""
    with suppress(KeyError):
        match reason:
            case "gain":
                return f"measures {evidence['gain']:.2f} times the resistance that the others do"
            case "offset":
                return f"places {math.hypot(evidence['offset_east_m'], evidence['offset_north_m']):.1f} m off"
            case "clock":
                return f"clock {evidence['clock_s']:+z.0f} s off"
            case "disagrees":
                return f"agrees with the others on {100 * evidence['agreement']:.0f} % of the ground"
            case "beyond_data_sheet":
                off = f"torque reads {evidence['torque_gain']:.2f} times what it should"
                return f"beyond its data sheet: {off}, accelerometer {evidence['zero']:.4f} off; a person may trust it"
    return reason


def calibrated(machine: MachineState, name: str) -> str:
    """The figure `zero` or `torque_gain`, its uncertainty and source; empty if unknown."""
    known = machine.evidence
    if name not in known:
        return ""
    return f"{known[name]:.4f} +- {known[f'{name}_std']:.4f}, {'+'.join(known[f'{name}_by']) or 'data sheet'}"


def calibrations(machines: Sequence[MachineState]) -> list[str]:
    """Two lines per machine whose calibration comes from the ground, up to MOST_LISTED."""
    known = [one for one in machines if one.evidence.get("zero_by") or one.evidence.get("torque_gain_by")]
    lines = []
    for machine in known[:MOST_LISTED]:
        lines.append(f"{machine.name}: zero {calibrated(machine, 'zero')}")
        lines.append(f"  torque x {calibrated(machine, 'torque_gain')}")
    return [*lines, f"and of {len(known) - MOST_LISTED} more"] if len(known) > MOST_LISTED else lines
