"""The messages of the wire as frozen records. `codec.py` turns them into bytes and back; docs/protocol.md specifies."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from protocol.arrays import Table
from protocol.errors import one_line
from protocol.machine.readings import Reading

VERSION = 1


@dataclass(frozen=True)
class SampleBatch:
    """Samples first_seq, first_seq + 1, ... of one spool.

    frame: the site frame of the positions (`SiteConfig.frame`). lost_before: how many samples directly before
    first_seq the bounded spool dropped. An empty batch asks for the watermark. store: id of the store that has
    acknowledged earlier samples of the spool, empty where none has.
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
        """Sequence number of the last sample."""
        return self.first_seq + len(self.rows) - 1


@dataclass(frozen=True)
class PackedBatch:
    """A batch as it came in. batch: without its samples; n: how many; columns: theirs, in the order of COLUMNS."""

    batch: SampleBatch
    n: int
    columns: tuple[bytes, ...]


@dataclass(frozen=True)
class CalibrationOffer:
    """What the map server takes off the newest samples of a machine, counted from what it measured.

    zero, scale: as a sample states them. zero_var, scale_var, covariance: of what is left. stamp_ns: the site's now
    when that was decided.
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

    row: the journal row; trimmed: samples it had already. store: id of the server's store; replaces: that of the batch,
    where it is another one, whose place this store takes. offer: a table of `CalibrationOffer`, or None; it is not
    checked with the acknowledgement, which holds whatever is offered. epoch: number of the server among all that ever
    wrote the store, 0 where it has none; of two acknowledgements that contradict each other, the higher one counts.
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
    """The server did not take a batch. expected: the next sequence number it would take, 0 where that is not known.

    retry_after_s: when there may be room for it again; 0 where that is not known, or not what keeps it out.
    reason, problem: one line each; characters that cannot be printed are escaped.
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
    """Readings of one machine over a short span. counter: 1, 2, 3... per stream; last: the stream ends here."""

    machine: str
    counter: int
    readings: tuple[Reading, ...]
    last: bool = False
    refused: Mapping[str, int] = field(default_factory=dict)  # readings skipped when decoding, by reason


@dataclass(frozen=True)
class Corrections:
    """What a relay has of a base. stamp_ns: when the newest frame came. frames: of RTCM3, whole, end to end.

    problem: what keeps frames from coming, in a sentence; empty where nothing does.
    """

    base: str
    stamp_ns: int
    frames: bytes
    problem: str = ""


@dataclass(frozen=True)
class Pose:
    """Live position of a machine in `map`."""

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
    """The health report of one agent. values: nested tables of plain values."""

    machine: str
    stamp_ns: int
    values: Mapping[str, Any]
