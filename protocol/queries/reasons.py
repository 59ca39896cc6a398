"""Why a cell has its value: the answer of `why` and its bytes (docs/protocol.md, "Why")."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass

from protocol.queries.answer_codec import MAX_REPLY_BYTES, take_record
from protocol.wire.fields import pack, unpack


@dataclass(frozen=True)
class Votes:
    """A cell's histogram. centres of bins; votes: metres in each; before: those before a change."""

    centres: tuple[float, ...]
    votes: tuple[float, ...]
    before: tuple[float, ...]


@dataclass(frozen=True)
class CellReasons:
    """Why a cell has its value.

    store, merged, fact: map version. x_m, y_m: centre. values: layers; before: those before its last change; None is
    unknown. metres: of valid evidence. newest_ns, changed_ns: stamps of newest sample and last change, or 0. sectors:
    metres by heading, counter-clockwise from east. machines: visitors; with many machines another may be named too.
    """

    store: str
    merged: int
    fact: int
    stamp_ns: int
    x_m: float
    y_m: float
    cell_m: float
    values: Mapping[str, float | None]
    before: Mapping[str, float | None]
    metres: float
    newest_ns: int
    changed_ns: int
    resistance: Votes
    grade_east: Votes
    grade_north: Votes
    sectors: tuple[float, ...]
    machines: tuple[str, ...]


def encode_why(reasons: CellReasons) -> bytes:
    """Answer of `why`."""
    return pack({"why": asdict(reasons)})


def decode_why(data: bytes) -> CellReasons:
    """Undo `encode_why`."""
    return take_record(CellReasons, unpack(data, MAX_REPLY_BYTES), "why")
