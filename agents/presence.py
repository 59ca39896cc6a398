"""What other processes see of a machine: live pose, health, a liveliness token, and an answer to who it is.

The token shows that an agent is there, for as long as the router believes so (up to the lease after a broken link). A
query on the same key is answered by a live agent only: so a machine that restarts never mistakes its own
killed predecessor for another agent. (A router passes nothing between two sessions in peer mode: of two agents that
both started without a router, neither sees the other. Their samples have different identities all the same, see
spool.py.)
"""

import os
import secrets
import socket
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import zenoh

from agents.localisation.filters.belief import PoseBelief
from protocol.errors import MessageError
from protocol.wire import keys
from protocol.wire.codec import MAX_SMALL_BYTES, encode_health, encode_pose, pack, take, unpack
from protocol.wire.messages import Health, Pose

POSE_NS = 200_000_000  # five a second, of the machine's own time
ANSWER_S = 1.0  # how long to wait for another agent of the same name
PATIENCE = 5  # looks without an answer, until another agent counts as gone
# Every agent but this one, each with its own answer.
EVERY_OTHER: Any = {
    "target": zenoh.QueryTarget.ALL,
    "consolidation": zenoh.ConsolidationMode.NONE,
    "allowed_destination": zenoh.Locality.REMOTE,
}


@dataclass(frozen=True, order=True)
class Owner:
    """One running agent. Of two with one name, the lesser one keeps it: the earlier, then by chance."""

    started_ns: int
    token: int
    host: str
    pid: int

    def __str__(self) -> str:
        return f"pid {self.pid} on host {self.host}"


def this_process(now_ns: Callable[[], int] = time.time_ns) -> Owner:
    """An agent that starts now in this process."""
    return Owner(now_ns(), secrets.randbits(62), socket.gethostname(), os.getpid())


def find_namesake(session: zenoh.Session, site: str, machine: str, wait_s: float = ANSWER_S) -> Owner | None:
    """Ask for a live agent of this name elsewhere; None if none answers."""
    asked = session.get(keys.alive(site, machine), timeout=wait_s, **EVERY_OTHER)
    return min((owner for reply in asked if (owner := _owner(reply))), default=None)


class Presence:
    """Publishes pose and health; a message may be lost, as the next one replaces it.

    While a machine catches up they wait for at most one batch of samples, which the uplink keeps to about a second.
    Zenoh's priorities do not help there, because a batch lies in the socket's buffer already.
    """

    def __init__(self, session: zenoh.Session, site: str, machine: str, owner: Owner | None = None) -> None:
        self._session = session
        self._machine = machine
        self._owner = owner or this_process()
        self._key = keys.alive(site, machine)
        drop = zenoh.CongestionControl.DROP
        self._pose = session.declare_publisher(keys.pose(site, machine), congestion_control=drop)
        self._health = session.declare_publisher(keys.health(site, machine), congestion_control=drop)
        self._answer = session.declare_queryable(self._key, self._on_query)
        self._token = session.liveliness().declare_token(self._key)
        self._pose_ns = 0
        self._answers: set[Owner] = set()
        self._rival: Owner | None = None
        self._missed = 0

    @property
    def owner(self) -> Owner:
        """Who this agent is."""
        return self._owner

    def look_around(self) -> Owner | None:
        """Return the agent whose name this is, if it is another one; and ask again for the next call.

        Answers arrive between two calls, within ANSWER_S.
        """
        answers, self._answers = self._answers, set()
        self._session.get(self._key, self._on_reply, timeout=ANSWER_S, **EVERY_OTHER)
        if rival := min((owner for owner in answers if owner < self._owner), default=None):
            self._rival, self._missed = rival, 0
        elif (missed := self._missed + 1) < PATIENCE:
            self._missed = missed
        else:
            self._rival = None
        return self._rival

    def show_pose(self, belief: PoseBelief) -> None:
        """Publish the pose if the last one is old enough."""
        if abs(belief.stamp_ns - self._pose_ns) < POSE_NS:
            return
        self._pose_ns = belief.stamp_ns
        (xx, xy), (_, yy) = belief.covariance_m2
        place = (belief.stamp_ns, belief.x_m, belief.y_m, belief.heading_rad, belief.speed_mps)
        self._pose.put(encode_pose(Pose(self._machine, *place, float(xx), float(xy), float(yy))))

    def show_health(self, stamp_ns: int, values: Mapping[str, Any]) -> None:
        """Publish a health report."""
        self._health.put(encode_health(Health(self._machine, stamp_ns, values)))

    def close(self) -> None:
        """Leave."""
        for entity in (self._token, self._answer, self._pose, self._health):
            entity.undeclare()  # type: ignore[no-untyped-call]

    def _on_query(self, query: zenoh.Query) -> None:
        with query:
            query.reply(query.key_expr, pack(asdict(self._owner)))

    def _on_reply(self, reply: zenoh.Reply) -> None:
        owner = _owner(reply)
        if owner and owner != self._owner:
            self._answers.add(owner)


def _owner(reply: zenoh.Reply) -> Owner | None:
    try:
        table = unpack(reply.ok.payload.to_bytes() if reply.ok else b"", MAX_SMALL_BYTES)
        fields = (("started_ns", int), ("token", int), ("host", str), ("pid", int))
        return Owner(*(take(table, name, kind) for name, kind in fields))
    except MessageError:
        return None
