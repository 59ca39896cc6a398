"""What other processes see of a machine: live pose, health, a liveliness token, and an answer to who it is.

The token shows that an agent is there, for as long as the router believes so (up to the lease after a broken link). A
query on the same key is answered by a live agent only: so a machine that restarts never mistakes its own
killed predecessor for another agent (protocol/wire/owners.py).
"""

from collections.abc import Mapping
from typing import Any

import zenoh

from agents.localisation.filters.belief import PoseBelief
from protocol.wire import keys
from protocol.wire.codec import encode_health, encode_pose
from protocol.wire.messages import Health, Pose
from protocol.wire.owners import ANSWER_S, EVERY_OTHER, Owner, encode_owner, owner_of, this_process

POSE_NS = 200_000_000  # five a second, of the machine's own time
PATIENCE = 5  # looks without an answer, until another agent counts as gone


def find_namesake(session: zenoh.Session, site: str, machine: str, wait_s: float = ANSWER_S) -> Owner | None:
    """Ask for a live agent of this name elsewhere; None if none answers."""
    asked = session.get(keys.alive(site, machine), timeout=wait_s, **EVERY_OTHER)
    return min((owner for reply in asked if (owner := owner_of(reply))), default=None)


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
            query.reply(query.key_expr, encode_owner(self._owner))

    def _on_reply(self, reply: zenoh.Reply) -> None:
        owner = owner_of(reply)
        if owner and owner != self._owner:
            self._answers.add(owner)
