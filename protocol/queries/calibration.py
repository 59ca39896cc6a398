"""What the map server takes off the samples of each machine: the answer of `calibration`, and its bytes.

(docs/protocol.md, "Calibration")
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

from protocol.queries.answer_codec import MAX_ITEMS, MAX_REPLY_BYTES, take_record
from protocol.wire.fields import pack, unpack


@dataclass(frozen=True)
class CorrectedSpan:
    """What is taken off a machine's samples with from_ns <= stamp < to_ns.

    zero: of the balance [-], which is also how much too low the slope ahead is [m/m]; scale: share of the measured
    drive force that is not there; across: how much too high the slope to the left is [m/m]. most_share: resistances of
    samples with a larger drive force over weight stay as they were.
    """

    from_ns: int
    to_ns: int
    zero: float
    scale: float
    across: float
    most_share: float


@dataclass(frozen=True)
class MachineCalibration:
    """The calibration of one machine by the map server.

    by: who decided last, `solver` or `person`, empty where nothing is decided; reason: one line; since_ns: the site's
    now then. zero, scale, across: as in CorrectedSpan, of the last solve, with standard deviations; None where it knows
    nothing of the machine. zero_by, scale_by: what shows them; empty: the data sheet has to do. spans: what counts,
    oldest first, of many the newest.
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

    store, merged, fact: the version of the map that `spans` count in. solved_ns: the site's now at the last solve, 0
    for none. common_scale_std: of the mean scale of all machines; common_scale_unknown: why nothing shows it, a word,
    empty where it is known.
    """

    store: str
    merged: int
    fact: int
    solved_ns: int
    common_scale_std: float
    common_scale_unknown: str
    machines: tuple[MachineCalibration, ...]


def encode_calibration(answer: CalibrationAnswer) -> bytes:
    """Answer of `calibration`, as a query and as a command."""
    return pack({"calibration": asdict(answer)})


def decode_calibration(data: bytes) -> CalibrationAnswer:
    """Undo `encode_calibration`."""
    return take_record(CalibrationAnswer, unpack(data, MAX_REPLY_BYTES, MAX_ITEMS), "calibration")
