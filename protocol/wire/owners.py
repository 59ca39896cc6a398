"""Who has a name on the network: a question that a live process answers, and no dead one.

A liveliness token would be there until the router believes that its process is gone, up to the lease of a broken link.
(A router passes nothing between two sessions in peer mode: of two agents that both started without a router, neither
sees the other. Their samples have different identities all the same, see agents/delivery/spool.py.)
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

ANSWER_S = 1.0  # how long to wait for answers
# Every process but this one, each with its own answer.
EVERY_OTHER: Any = {
    "target": zenoh.QueryTarget.ALL,
    "consolidation": zenoh.ConsolidationMode.NONE,
    "allowed_destination": zenoh.Locality.REMOTE,
}


@dataclass(frozen=True, order=True)
class Owner:
    """One running process. Of two with one name, the lesser one keeps it: the earlier, then by chance."""

    started_ns: int
    token: int
    host: str
    pid: int

    def __str__(self) -> str:
        return f"pid {self.pid} on host {self.host}"


def this_process(now_ns: Callable[[], int] = time.time_ns) -> Owner:
    """The owner that this process is if it starts now."""
    return Owner(now_ns(), secrets.randbits(62), socket.gethostname(), os.getpid())


def encode_owner(owner: Owner, **more: Any) -> bytes:
    """An answer to who it is."""
    return pack(asdict(owner) | more)


def decode_owner(data: bytes) -> tuple[Owner, dict[str, Any]]:
    """Undo `encode_owner`: the owner, and all fields of the answer."""
    table = unpack(data, MAX_SMALL_BYTES)
    fields = (("started_ns", int), ("token", int), ("host", str), ("pid", int))
    return Owner(*(take(table, name, kind) for name, kind in fields)), table


def owner_of(reply: zenoh.Reply) -> Owner | None:
    """Who has answered; None where that cannot be read."""
    try:
        return decode_owner(reply.ok.payload.to_bytes() if reply.ok else b"")[0]
    except MessageError:
        return None
