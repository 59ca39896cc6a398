"""Roads, and where work on them pays: the queries `segments` and `worklist`, their answers, and their bytes.

(docs/protocol.md, "Roads")
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

from protocol.errors import QueryError, Refusal
from protocol.queries import parameters as ps
from protocol.queries.answer_codec import MAX_ITEMS, MAX_REPLY_BYTES, take_record
from protocol.queries.parameters import ANY_ROW, Freshness
from protocol.site.geometry import Bounds
from protocol.wire.codec import pack, unpack

Line = tuple[tuple[float, ...], ...]
MAX_LIMIT = 1000  # stretches of one worklist
SEGMENTS = ("from", "to", "as_of", "bounds", "machine")
WORKLIST = ("target", "efficiency", "limit", *SEGMENTS)


@dataclass(frozen=True)
class RoadSegment:
    """About 25 m of a road. Pairs are by direction: along the line, and back.

    id: a place, the same as long as the road is. line: x, y [m]. resistance with its standard deviation, grade (rise
    over run along the line), trend (change of resistance a day): None where not known. unmeasured: share of it without
    a resistance. passes_ph, tonnes_ph: an hour; guessed: no machine stated a mass. machines: about how many.
    """

    id: str
    line: Line
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


@dataclass(frozen=True)
class Segments:
    """Roads of a map. hours: that the traffic is of. placed: share of all metres driven that lie on a road."""

    store: str
    merged: int
    fact: int
    stamp_ns: int
    hours: float
    placed: float
    segments: tuple[RoadSegment, ...]


@dataclass(frozen=True)
class WorklistRow:
    """What a stretch costs an hour, over ground of the target's resistance: value, low and high of 90 %.

    rank: from 1; stretches that differ by less than the noise have the same. since_ns: since when the ground is so: the
    first pass after its last change, or the first hour of which its resistance is remembered. before, saved_kwh_ph:
    resistance before that change, and what it saves an hour (below 0: it became worse); None for no change.
    day_ns, day_resistance: begins of days with measurements, the oldest first, and the mean resistance of each.
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
    """A stretch whose ground changed: repaired, or become worse, as two passes in a row showed.

    id, line: as of its segment. first_ns: of the first pass that saw it, to the minute; seen_ns: when that was sure.
    before, after: resistance. saved_kwh_ph: less lost an hour at the target, with the same traffic; below 0 where it
    is worse.
    """

    id: str
    line: Line
    first_ns: int
    seen_ns: int
    before: float
    after: float
    saved_kwh_ph: float


@dataclass(frozen=True)
class Worklist:
    """Where work on roads pays, as the ground is since its last change.

    total_kwh_ph: of all stretches, in the list or not. changes: the newest first.
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


def encode_segments(answer: Segments) -> bytes:
    """Answer of `segments`."""
    return pack({"segments": asdict(answer)})


def decode_segments(data: bytes) -> Segments:
    """Undo `encode_segments`."""
    return take_record(Segments, unpack(data, MAX_REPLY_BYTES, MAX_ITEMS), "segments")


def encode_worklist(answer: Worklist) -> bytes:
    """Answer of `worklist`."""
    return pack({"worklist": asdict(answer)})


def decode_worklist(data: bytes) -> Worklist:
    """Undo `encode_worklist`."""
    return take_record(Worklist, unpack(data, MAX_REPLY_BYTES, MAX_ITEMS), "worklist")


@dataclass(frozen=True)
class SegmentsQuery:
    """Roads of the map, segment by segment, and what drove on them.

    from_ns, to_ns: traffic of the hours that begin in from_ns <= time < to_ns, None for all that is remembered.
    as_of_ns: from samples stamped so or earlier. bounds: segments whose middle lies there. machine: traffic of this one
    alone, and what it measured; "" for all.
    """

    from_ns: int | None = None
    to_ns: int | None = None
    as_of_ns: int | None = None
    bounds: Bounds | None = None
    machine: str = ""
    fresh: Freshness = ANY_ROW

    name = "segments"


@dataclass(frozen=True)
class WorklistQuery:
    """Where work on roads pays: segments that cost more than ground of a target c_rr would, the dearest first.

    efficiency: of engine and drive train, for litres. limit: at most so many. The others: as in SegmentsQuery.
    """

    target: float = 0.02
    efficiency: float = 0.35
    limit: int = 100
    from_ns: int | None = None
    to_ns: int | None = None
    as_of_ns: int | None = None
    bounds: Bounds | None = None
    machine: str = ""
    fresh: Freshness = ANY_ROW

    name = "worklist"

    def __post_init__(self) -> None:
        if not 0 < self.target <= 1:
            raise QueryError(Refusal.OUT_OF_RANGE, f"parameter `target`: {self.target:g} is not above 0 and at most 1")
        if not 0 < self.efficiency <= 1:
            problem = f"parameter `efficiency`: {self.efficiency:g} is not above 0 and at most 1"
            raise QueryError(Refusal.OUT_OF_RANGE, problem)
        if not 1 <= self.limit <= MAX_LIMIT:
            problem = f"parameter `limit`: {self.limit} is not between 1 and {MAX_LIMIT}"
            raise QueryError(Refusal.OUT_OF_RANGE, problem)


RoadQuery = SegmentsQuery | WorklistQuery


def encode_roads(query: RoadQuery) -> dict[str, str]:
    """Selector parameters, but for the row that is waited for."""
    parameters = ps.text_of_stamps({"from": query.from_ns, "to": query.to_ns, "as_of": query.as_of_ns})
    if query.bounds:
        parameters["bounds"] = ps.text_of_bounds(query.bounds)
    if query.machine:
        parameters["machine"] = ps.quoted(query.machine)
    if isinstance(query, WorklistQuery):
        numbers = {"target": ps.text_of(query.target), "efficiency": ps.text_of(query.efficiency)}
        parameters |= {**numbers, "limit": str(query.limit)}
    return parameters


def parse_segments(parameters: ps.Parameters) -> SegmentsQuery:
    """Undo `encode_roads`; QueryError says what is wrong with which parameter."""
    bounds = ps.bounds(parameters) if "bounds" in parameters else None
    machine = ps.free_text(parameters, "machine")
    as_of_ns, fresh = ps.stamp(parameters, "as_of"), ps.freshness(parameters)
    return SegmentsQuery(*ps.times(parameters), as_of_ns, bounds, machine, fresh)


def parse_worklist(parameters: ps.Parameters) -> WorklistQuery:
    """As `parse_segments`."""
    same, default = parse_segments(parameters), WorklistQuery()
    target, efficiency = (
        ps.number({name: ps.text_of(getattr(default, name)), **parameters}, name) for name in ("target", "efficiency")
    )
    limit = ps.count({"limit": str(default.limit), **parameters}, "limit")
    return WorklistQuery(target, efficiency, limit, **vars(same))
