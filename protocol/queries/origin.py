"""Who answered a map query, and its lag behind the journal (docs/protocol.md, "Who answers").

It stands beside the answer: answers of one map version are the same bytes from anyone.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass

from protocol.errors import MessageError, Refusal
from protocol.wire.fields import MAX_SMALL_BYTES, pack, take, take_name, unpack

SHOWN_S = 10.0  # lag beyond which a follower is not offered to clients


@dataclass(frozen=True)
class Origin:
    """Source of an answer. follower: its name, empty for the map server.

    behind_rows: journalled rows missing in its map. behind_s: upper bound of the map's lag [s].
    """

    follower: str = ""
    behind_rows: int = 0
    behind_s: float = 0.0

    def __str__(self) -> str:
        who = f"follower {self.follower}" if self.follower else "the map server"
        return f"{who}, {self.behind_rows} rows and {self.behind_s:.1f} s behind the journal"


SERVER = Origin()


def encode_origin(origin: Origin) -> bytes:
    """An answer's attachment."""
    table = asdict(origin)
    return pack(table if origin.follower else {name: table[name] for name in table if name != "follower"})


def decode_origin(data: bytes) -> Origin:
    """Undo `encode_origin`."""
    table = unpack(data, MAX_SMALL_BYTES)
    follower = take_name(table, "follower") if table.get("follower") is not None else ""
    rows, seconds = take(table, "behind_rows", int), take(table, "behind_s", float)
    if rows < 0 or not 0 <= seconds < math.inf:
        raise MessageError(Refusal.OUT_OF_RANGE, f"{rows} rows, {seconds} s", field="behind_rows, behind_s")
    return Origin(follower, rows, seconds)
