"""Wire messages as frozen records. `codec.py` converts them; docs/protocol.md specifies them."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from protocol.arrays import Table
from protocol.errors import one_line
from protocol.machine.readings import Reading

VERSION = 1


@dataclass(frozen=True)
class SampleBatch:
    """Samples first_seq, first_seq + 1, ... of a spool; an empty batch asks for the watermark.

    frame: of the positions (`SiteConfig.frame`). lost_before: samples dropped directly before first_seq. store: id of
    the store that acknowledged earlier samples, or empty.
    """

    machine: str
    spool_id: int
    first_seq: int
    rows: Table
    frame: str
    lost_before: int = 0
    store: str = ""

    @property
    def last_seq(self) -> int:
        """Seq of the last sample."""
        return self.first_seq + len(self.rows) - 1


@dataclass(frozen=True)
class PackedBatch:
    """A received batch. batch: without samples; n: their number; columns: theirs, in the order of COLUMNS."""

    batch: SampleBatch
    n: int
    columns: tuple[bytes, ...]


@dataclass(frozen=True)
class CalibrationOffer:
    """The map server's correction of a machine's newest samples, relative to its raw measurement.

    zero, scale: as in samples. zero_var, scale_var, covariance: of the rest. stamp_ns: the site's now at the decision.
    """

    machine: str
    stamp_ns: int
    zero: float
    scale: float
    zero_var: float
    scale_var: float
    covariance: float


@dataclass(frozen=True)
class Ack:
    """Everything up to `watermark` is on the server's disk.

    row: journal row; trimmed: samples it already had. store: the server's; replaces: the batch's store, which this one
    replaces. offer: unchecked table of `CalibrationOffer`, or None: the acknowledgement holds anyway. epoch: number of
    the server among the store's writers, or 0; in contradictions the higher counts.
    """

    watermark: int
    row: int
    trimmed: int = 0
    store: str = ""
    replaces: str = ""
    offer: Any = None
    epoch: int = field(default=0, compare=False)


@dataclass(frozen=True)
class Refused:
    """A batch was not taken. expected: next acceptable seq, 0 if unknown.

    retry_after_s: when there may be room, 0 if unknown or irrelevant. reason, problem: one line each, escaped.
    """

    reason: str
    problem: str
    expected: int = 0
    retry_after_s: float = 0.0

    def __post_init__(self) -> None:
        for name in ("reason", "problem"):
            object.__setattr__(self, name, one_line(getattr(self, name)))


@dataclass(frozen=True)
class SensorBundle:
    """A machine's readings over a short span. counter: 1, 2, 3... per stream; last: its end."""

    machine: str
    counter: int
    readings: tuple[Reading, ...]
    last: bool = False
    refused: Mapping[str, int] = field(default_factory=dict)  # skipped when decoding, by reason


@dataclass(frozen=True)
class Corrections:
    """A relay's message. stamp_ns: newest frame. frames: whole RTCM3, end to end. problem: why none come, or ""."""

    base: str
    stamp_ns: int
    frames: bytes
    problem: str = ""


@dataclass(frozen=True)
class Pose:
    """A machine's live position in `map`."""

    machine: str
    stamp_ns: int
    x_m: float
    y_m: float
    heading_rad: float
    speed_mps: float
    cov_xx_m2: float
    cov_xy_m2: float
    cov_yy_m2: float


@dataclass(frozen=True)
class Health:
    """An agent's health. values: nested tables of plain values."""

    machine: str
    stamp_ns: int
    values: Mapping[str, Any]
