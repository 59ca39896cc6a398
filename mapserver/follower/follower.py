"""A follower's edge to Zenoh: it answers map queries under its own name, and shows a token while its map is of now."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable

import zenoh

from mapserver.config import ServerConfig
from mapserver.follower.follower_source import FollowerSource
from mapserver.follower.following import Following
from mapserver.journal.location import JournalLocation
from mapserver.query.answering import Answers
from mapserver.query.queryable import MapQueryable
from protocol.errors import LinkError
from protocol.queries.origin import SHOWN_S
from protocol.site.site_config import SiteConfig
from protocol.wire import keys
from protocol.wire.owners import ANSWER_S, EVERY_OTHER, Owner, encode_owner, owner_of, this_process

LOOK_S = 2.0  # between two looks for another follower of the same name


class Follower:
    """Serves queries of one site from a journal, over an open session, until closed. Call `tend` twice a second."""

    def __init__(
        self,
        session: zenoh.Session,
        name: str,
        journal: JournalLocation,
        site: SiteConfig,
        config: ServerConfig,
        now_ns: Callable[[], int],
    ) -> None:
        """LinkError where another follower has this name."""
        self._session, self._owner, self._key = session, this_process(), keys.follower_owner(site.name, name)
        self._token_key = keys.follower_alive(site.name, name)
        self._token: zenoh.LivelinessToken | None = None
        self._rivals: set[Owner] = set()
        self._look_s = time.monotonic() + LOOK_S
        self.following = Following(journal, site, config)
        self.source = FollowerSource(name, self.following, now_ns)
        self.answers = Answers(self.source)
        # Declared before anybody is asked: of two that start at once, one at least hears the other.
        self._identity = session.declare_queryable(self._key, self._on_owner)
        others = (owner_of(reply) for reply in session.get(self._key, timeout=ANSWER_S, **EVERY_OTHER))
        self._rivals = {owner for owner in others if owner}
        if self.ended:
            self._identity.undeclare()  # type: ignore[no-untyped-call]
            self.following.close()
            raise LinkError(f"follower {name}", f"{self.ended}; choose another --name")
        self._queries = MapQueryable(session, keys.follower_queries(site.name, name), self.source, self.answers)
        self.following.start()
        self.answers.start()

    @property
    def is_shown(self) -> bool:
        """Whether clients see it."""
        return self._token is not None

    @property
    def ended(self) -> str:
        """Why it cannot go on, empty while it can; the process should end."""
        if earlier := [owner for owner in self._rivals if owner < self._owner]:
            return f"another follower has this name, {min(earlier)}"
        return self.following.ended

    def tend(self) -> None:
        """Show the token while the map is of now, and look for others of this name."""
        _, behind_s = self.following.behind()
        if behind_s <= SHOWN_S and not self._token:
            self._token = self._session.liveliness().declare_token(self._token_key)
        elif behind_s > SHOWN_S and self._token:
            logging.getLogger("mapserver.follower").warning("behind seconds=%.0f: clients ask others", behind_s)
            self._hide()
        if time.monotonic() >= self._look_s:
            self._look_s = time.monotonic() + LOOK_S
            self._session.get(self._key, self._on_other, timeout=ANSWER_S, **EVERY_OTHER)

    def close(self) -> None:
        """Take no more queries, and end what is in work."""
        self._hide()
        self._queries.stop()
        self.following.stop()
        self._queries.close()
        self.answers.close()
        self._identity.undeclare()  # type: ignore[no-untyped-call]
        self.following.close()

    def _hide(self) -> None:
        if self._token:
            self._token.undeclare()  # type: ignore[no-untyped-call]
            self._token = None

    def _on_owner(self, query: zenoh.Query) -> None:
        with query:
            query.reply(query.key_expr, encode_owner(self._owner))

    def _on_other(self, reply: zenoh.Reply) -> None:
        if (owner := owner_of(reply)) and owner != self._owner:
            self._rivals = self._rivals | {owner}
