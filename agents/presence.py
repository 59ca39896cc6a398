"""What others see of a machine: live pose, health, liveliness token, and an answer to who it is.

The token lasts as long as the router trusts it (up to the lease after a broken link). Only live agents answer a query
on the same key, so a restarted machine never takes its killed predecessor for another agent (protocol/wire/owners.py).
"""

from collections.abc import Mapping
from typing import Any

import zenoh

from agents.localisation.filters.belief import PoseBelief
from protocol.wire import keys
from protocol.wire.codec import encode_health, encode_pose
from protocol.wire.messages import Health, Pose
from protocol.wire.owners import ANSWER_S, EVERY_OTHER, Owner, encode_owner, owner_of, this_process

POSE_NS = 200_000_000  # five per second of machine time
PATIENCE = 5  # looks without answer until another agent counts as gone


def find_namesake(session: zenoh.Session, site: str, machine: str, wait_s: float = ANSWER_S) -> Owner | None:
    """Ask for a live agent of this name elsewhere; None without answer."""
    asked = session.get(keys.alive(site, machine), timeout=wait_s, **EVERY_OTHER)
    return min((owner for reply in asked if (owner := owner_of(reply))), default=None)


class Presence:
    """Publishes pose and health; the next message replaces a lost one.

    During catch-up they wait for at most one batch, about a second; Zenoh's priorities do not help, as the batch is
    already in the socket's buffer.
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
        """The agent itself."""
        return self._owner

    def look_around(self) -> Owner | None:
        """The other agent that holds this name, or None; asks again for the next call."""
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
        """Publish the pose, if due."""
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
            query.reply(query.key_expr, encode_owner(self._owner))

    def _on_reply(self, reply: zenoh.Reply) -> None:
        owner = owner_of(reply)
        if owner and owner != self._owner:
            self._answers.add(owner)
