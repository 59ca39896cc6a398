"""Roads, and where work on them pays: the answers of `segments` and `worklist`, and their bytes.

(docs/protocol.md, "Roads")
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

from protocol.queries.answer_codec import MAX_ITEMS, MAX_REPLY_BYTES, take_record
from protocol.wire.codec import pack, unpack

Line = tuple[tuple[float, ...], ...]


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
