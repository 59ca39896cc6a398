"""Who holds a name on the network: a question that only live processes answer.

A liveliness token outlives its process until the router notices, up to a broken link's lease. (Routers pass nothing
between two peer sessions: agents that started without a router do not see each other. Their samples still have
different identities, see agents/delivery/spool.py.)
"""

import os
import secrets
import socket
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import zenoh

from protocol.errors import MessageError
from protocol.wire.fields import MAX_SMALL_BYTES, pack, take, unpack

ANSWER_S = 1.0  # wait for answers
# All other processes, each with its own answer.
EVERY_OTHER: Any = {
    "target": zenoh.QueryTarget.ALL,
    "consolidation": zenoh.ConsolidationMode.NONE,
    "allowed_destination": zenoh.Locality.REMOTE,
}


@dataclass(frozen=True, order=True)
class Owner:
    """A running process. The lesser of two with one name keeps it: the earlier, then by chance."""

    started_ns: int
    token: int
    host: str
    pid: int

    def __str__(self) -> str:
        return f"pid {self.pid} on host {self.host}"


def this_process(now_ns: Callable[[], int] = time.time_ns) -> Owner:
    """The current process as an owner starting now."""
    return Owner(now_ns(), secrets.randbits(62), socket.gethostname(), os.getpid())


def encode_owner(owner: Owner, **more: Any) -> bytes:
    """Answer to who it is."""
    return pack(asdict(owner) | more)


def decode_owner(data: bytes) -> tuple[Owner, dict[str, Any]]:
    """Undo `encode_owner`: owner and all fields."""
    table = unpack(data, MAX_SMALL_BYTES)
    fields = (("started_ns", int), ("token", int), ("host", str), ("pid", int))
    return Owner(*(take(table, name, kind) for name, kind in fields)), table


def owner_of(reply: zenoh.Reply) -> Owner | None:
    """Who answered; None if unreadable."""
    try:
        return decode_owner(reply.ok.payload.to_bytes() if reply.ok else b"")[0]
    except MessageError:
        return None
