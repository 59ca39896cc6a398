"""The answer of `calibration`, corrections of machines' samples, and its bytes (docs/protocol.md, "Calibration")."""

from __future__ import annotations

from dataclasses import asdict, dataclass

from protocol.queries.answer_codec import MAX_REPLY_BYTES, take_record
from protocol.wire.fields import pack, unpack


@dataclass(frozen=True)
class CorrectedSpan:
    """Correction of samples with from_ns <= stamp < to_ns.

    zero: bias of the balance [-], so the slope ahead is too low by it [m/m]; scale: false share of measured drive
    force; across: excess of the slope to the left [m/m]. most_share: drive force over weight up to which resistances
    are corrected.
    """

    from_ns: int
    to_ns: int
    zero: float
    scale: float
    across: float
    most_share: float


@dataclass(frozen=True)
class MachineCalibration:
    """A machine's calibration by the map server.

    by: last decision by `solver`, `person` or empty; reason: one line; since_ns: the site's now then. zero, scale,
    across: see CorrectedSpan, of the last solve, with standard deviations, or None. zero_by, scale_by: what shows them;
    empty: the data sheet. spans: in effect, oldest first, limited to the newest.
    """

    name: str
    by: str
    reason: str
    since_ns: int
    zero: float | None
    zero_std: float | None
    scale: float | None
    scale_std: float | None
    across: float | None
    across_std: float | None
    zero_by: tuple[str, ...]
    scale_by: tuple[str, ...]
    spans: tuple[CorrectedSpan, ...]


@dataclass(frozen=True)
class CalibrationAnswer:
    """All machines.

    store, merged, fact: map version of `spans`. solved_ns: the site's now at the last solve, or 0. common_scale_std: of
    the machines' mean scale; common_scale_unknown: a word for why nothing shows it, or empty.
    """

    store: str
    merged: int
    fact: int
    solved_ns: int
    common_scale_std: float
    common_scale_unknown: str
    machines: tuple[MachineCalibration, ...]


def encode_calibration(answer: CalibrationAnswer) -> bytes:
    """Answer of `calibration`, query and command."""
    return pack({"calibration": asdict(answer)})


def decode_calibration(data: bytes) -> CalibrationAnswer:
    """Undo `encode_calibration`."""
    return take_record(CalibrationAnswer, unpack(data, MAX_REPLY_BYTES), "calibration")
