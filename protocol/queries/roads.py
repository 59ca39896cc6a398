"""Roads, and sections worth grading: `segments` and `worklist`, answers and bytes (docs/protocol.md, "Roads")."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TypeVar

from protocol.queries.answer_codec import MAX_REPLY_BYTES, take_record
from protocol.queries.parameters import LINE, RECTANGLE, STAMP, check_order, count, number
from protocol.queries.request import AsOf, Codec, Fresh, asked
from protocol.site.geometry import Bounds
from protocol.wire.fields import pack, unpack

Corners = tuple[tuple[float, ...], ...]
MAX_LIMIT = 1000  # sections of one worklist
SHARE = number(0.0, 1.0, above=True)
T = TypeVar("T")


@dataclass(frozen=True)
class Fuel:
    """Litres per hour: value, low and high of 90 %. predicted: by resistance, grade, mass and speed of the same drives.

    share: of driven metres with stated consumption, on which both rest.
    """

    burned_ph: tuple[float, ...]
    predicted_ph: tuple[float, ...]
    share: float


@dataclass(frozen=True)
class RoadSegment:
    """About 25 m of a road. Pairs: along the line, and back.

    id: of the place, lasting as long as the road. line: x, y [m]. resistance, resistance_std, grade (rise over run
    along the line), trend (resistance per day): None if unknown. unmeasured: share without resistance. passes_ph,
    tonnes_ph: per hour; guessed: no machine stated a mass. machines: approximate number. fuel: None if not stated.
    """

    id: str
    line: Corners
    length_m: float
    resistance: float | None
    resistance_std: float | None
    grade: float | None
    trend: float | None
    unmeasured: float
    passes_ph: tuple[float, ...]
    tonnes_ph: tuple[float, ...]
    guessed: bool
    machines: int
    fuel: Fuel | None = None


@dataclass(frozen=True)
class Segments:
    """Roads of a map. hours: of the traffic. placed: share of driven metres on roads."""

    store: str
    merged: int
    fact: int
    stamp_ns: int
    hours: float
    placed: float
    segments: tuple[RoadSegment, ...]


@dataclass(frozen=True)
class WorklistRow:
    """Hourly cost of a section over target ground: value, low and high of 90 %.

    rank: from 1; ties within the noise. since_ns: first pass after the ground's last change, or the first remembered
    hour. before, saved_kwh_ph: resistance before that change, and hourly saving (below 0: worse); None without change.
    day_ns, day_resistance: measured days, oldest first, with mean resistance.
    """

    rank: int
    segment: RoadSegment
    kwh_ph: tuple[float, ...]
    litres_ph: tuple[float, ...]
    seconds_ph: tuple[float, ...]
    since_ns: int
    before: float | None
    saved_kwh_ph: float | None
    day_ns: tuple[int, ...]
    day_resistance: tuple[float, ...]


@dataclass(frozen=True)
class RoadChange:
    """A section that was repaired or became worse, as two passes in a row showed.

    id, line, fuel: as of its segment. first_ns: first pass after it, to the minute; seen_ns: when certain. before,
    after: resistance. saved_kwh_ph: at the target, with the same traffic; below 0 if worse.
    """

    id: str
    line: Corners
    first_ns: int
    seen_ns: int
    before: float
    after: float
    saved_kwh_ph: float
    fuel: Fuel | None = None


@dataclass(frozen=True)
class Worklist:
    """Sections worth grading, by the ground since its last change.

    total_kwh_ph: of all sections, listed or not. changes: newest first.
    """

    store: str
    merged: int
    fact: int
    stamp_ns: int
    hours: float
    target: float
    total_kwh_ph: float
    rows: tuple[WorklistRow, ...]
    changes: tuple[RoadChange, ...]


def _said(items: list[tuple[str, object]]) -> dict[str, object]:
    return {name: value for name, value in items if name != "fuel" or value is not None}


def encode_segments(answer: Segments) -> bytes:
    """Answer of `segments`."""
    return pack({"segments": asdict(answer, dict_factory=_said)})


def decode_segments(data: bytes) -> Segments:
    """Undo `encode_segments`."""
    return take_record(Segments, unpack(data, MAX_REPLY_BYTES), "segments")


def encode_worklist(answer: Worklist) -> bytes:
    """Answer of `worklist`."""
    return pack({"worklist": asdict(answer, dict_factory=_said)})


def decode_worklist(data: bytes) -> Worklist:
    """Undo `encode_worklist`."""
    return take_record(Worklist, unpack(data, MAX_REPLY_BYTES), "worklist")


@dataclass(frozen=True, kw_only=True)
class RoadQuery(AsOf[T], Fresh[T]):
    """A query of roads.

    from_ns, to_ns: traffic of hours beginning in from_ns <= time < to_ns, None for all remembered. bounds: of segment
    centres. machine: only its traffic and measurements; "" for all.
    """

    from_ns: int | None = asked(STAMP, "from", "traffic of the hours that begin from then on", None)
    to_ns: int | None = asked(STAMP, "to", "traffic of the hours before this time", None)
    bounds: Bounds | None = asked(RECTANGLE, "bounds", "west,south,east,north [m]", None)
    machine: str = asked(LINE, "machine", "traffic of this machine alone, and what it measured", "")

    def __post_init__(self) -> None:
        super().__post_init__()
        check_order(self.from_ns, self.to_ns)

    @property
    def reads_past(self) -> bool:
        """See `MapQuery`."""
        return True


@dataclass(frozen=True)
class SegmentsQuery(RoadQuery[Segments]):
    """Roads by segment, with traffic."""

    name = "segments"
    help = "roads that the map shows, and what drove on them"
    codec = Codec(encode_segments, decode_segments)


@dataclass(frozen=True)
class WorklistQuery(RoadQuery[Worklist]):
    """Road sections that cost more than ground of the target c_rr, most expensive first.

    efficiency: of engine and drive train, for litres. limit: of rows.
    """

    target: float = asked(SHARE, "target", "rolling resistance of good ground, above 0 and at most 1", 0.02)
    efficiency: float = asked(SHARE, "efficiency", "of engine and drive train, above 0 and at most 1", 0.35)
    limit: int = asked(count(1, MAX_LIMIT), "limit", f"stretches, 1 to {MAX_LIMIT}", 100)

    name = "worklist"
    help = "road sections that are worth grading, most expensive first"
    codec = Codec(encode_worklist, decode_worklist)
