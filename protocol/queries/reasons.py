"""Why a cell has its value: the answer of `why`, and its bytes (docs/protocol.md, "Why")."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass

from protocol.queries.answer_codec import MAX_ITEMS, MAX_REPLY_BYTES, take_record
from protocol.wire.fields import pack, unpack


@dataclass(frozen=True)
class Votes:
    """A histogram of one cell. centres of the bins; votes: metres driven, in each; before: those before a change."""

    centres: tuple[float, ...]
    votes: tuple[float, ...]
    before: tuple[float, ...]


@dataclass(frozen=True)
class CellReasons:
    """Why a cell has its value.

    store, merged, fact: the version of the map. x_m, y_m: centre of the cell. values: its layers; before: those of the
    evidence before its last change; None is unknown. metres: of evidence that holds. newest_ns: stamp of its newest
    sample, changed_ns: of its last change; 0 for none. sectors: metres driven by heading, from east, counter-clockwise.
    machines: who was here; with more than a few machines on the site, another one may be named too.
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
    return take_record(CellReasons, unpack(data, MAX_REPLY_BYTES, MAX_ITEMS), "why")
