"""The query `coverage`: how much ground is known, how old, by whom; its answer and bytes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass

from protocol.queries.answer_codec import MAX_REPLY_BYTES, take_record
from protocol.queries.parameters import RECTANGLE
from protocol.queries.request import AsOf, Codec, Fresh, Size, asked
from protocol.site.geometry import Bounds
from protocol.wire.fields import pack, unpack


@dataclass(frozen=True)
class Coverage:
    """Ground of an area [m2].

    driven_m2: of driven cells; known_m2: with known resistance. driven_since_m2: driven in the last hour, day, week
    before stamp_ns. machines_m2: by machine; with many machines another's ground may be counted too.
    """

    store: str
    merged: int
    fact: int
    stamp_ns: int
    driven_m2: float
    known_m2: float
    driven_since_m2: Mapping[str, float]
    machines_m2: Mapping[str, float]


def _encode(answer: Coverage) -> bytes:
    return pack({"coverage": asdict(answer)})


def _decode(data: bytes) -> Coverage:
    return take_record(Coverage, unpack(data, MAX_REPLY_BYTES), "coverage")


@dataclass(frozen=True)
class CoverageQuery(AsOf[Coverage], Fresh[Coverage]):
    """Driven and known ground, by age and machine, in a rectangle or (None) the whole map."""

    bounds: Bounds | None = asked(RECTANGLE, "bounds", "west,south,east,north [m]; default all of the map", None)

    name = "coverage"
    help = "how much ground is driven and known, by age and machine"
    codec = Codec(_encode, _decode)
    size = Size.SEARCH

    @property
    def is_long(self) -> bool:
        """See `MapQuery`."""
        return True
