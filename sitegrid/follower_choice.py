"""Choice of the process to query: a follower for map reads, else the map server.

Queryables on one key would all work on every query; of complete ones Zenoh picks always the same
(docs/decisions/0028-followers.md). So each follower has keys of its own and a liveliness token. A client stays with one
follower, so its reads never go back in time.
"""

from __future__ import annotations

import hashlib
import secrets
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from enum import Enum, auto
from typing import Any

import zenoh

from protocol.errors import ConfigError, LinkError, MessageError, QueryError, Refusal
from protocol.queries.answer_codec import decode_alive, decode_error
from protocol.queries.answers import FollowerState, ServerAlive
from protocol.queries.origin import SERVER, Origin, decode_origin
from protocol.queries.parameters import selector_of, text_of
from protocol.queries.request import AskFirst, MapQuery
from protocol.queries.requests import AliveQuery
from protocol.wire import keys

# Nobody answered at once: the server restarts, or has just connected (Zenoh issue 2767).
AGAIN_S = 0.1
PAST_S = 120.0  # extra timeout for answers folded from the journal
LOOK_S = 1.0  # between two searches for followers, each 0.1 ms of the router
KNOWN_S = 1.0  # timeout for the router's matching status
AVOID_S = 10.0  # pause after a follower failed to answer: its link's lease ends within it, and with it the token
FOLLOWERS_TRIED = 2  # per query before the server; each may take half of the remaining time
FOLLOWER_WAIT_S = 1.0  # for a row that a follower lacks; a healthy one has it after 0.5 s
TIMED_OUT = b"Timeout"  # Zenoh's own error reply
# Refusals that concern the process, not the query.
ELSEWHERE = (Refusal.AFTER_TIMEOUT, Refusal.NOT_HERE, Refusal.OVERLOADED, Refusal.STORE, "internal")


@dataclass(frozen=True)
class Answered:
    """An answer and its origin."""

    data: bytes
    origin: Origin


class _Silence(Enum):
    """No answer. NOBODY: no process took the query, or it ended."""

    NOBODY = auto()
    TIMED_OUT = auto()


@dataclass(frozen=True)
class _Attempt:
    """A query to one process. follower: empty for the server."""

    key: str
    parameters: Mapping[str, str]
    follower: str = ""

    @property
    def selector(self) -> zenoh.Selector:
        return zenoh.Selector(self.key, selector_of(self.parameters)) if self.parameters else zenoh.Selector(self.key)


class Followers:
    """Reachable followers, in this client's order of preference."""

    def __init__(self, session: zenoh.Session, site: str) -> None:
        self._session, self._site = session, site
        self._client = secrets.token_bytes(8)
        self._names: list[str] = []
        self._look_s = 0.0  # time of the next search
        self._avoided: dict[str, float] = {}  # until when

    def in_order(self) -> list[str]:
        """Names, preferred first."""
        now_s = time.monotonic()
        if now_s >= self._look_s:
            self._names, self._look_s = preferred(self._client, self.look()), time.monotonic() + LOOK_S
        return [name for name in self._names if self._avoided.get(name, 0.0) <= now_s]

    def look(self) -> set[str]:
        """Names with a liveliness token."""
        replies = self._session.liveliness().get(keys.followers_alive_all(self._site), timeout=1.0)
        return {name for reply in replies if reply.ok is not None and (name := _name(str(reply.ok.key_expr)))}

    def avoid(self, name: str) -> None:
        """Skip a follower for AVOID_S, and search again."""
        self._avoided[name] = time.monotonic() + AVOID_S
        self._look_s = 0.0


def is_answered(session: zenoh.Session, key: str) -> bool:
    """Whether the router knows a queryable on a key, even one that this client may not query."""
    querier: Any = session.declare_querier(key)  # matching_status is an object, although declared a bool
    try:
        end_s = time.monotonic() + KNOWN_S
        while not querier.matching_status.matching:
            if time.monotonic() >= end_s:
                return False
            time.sleep(0.02)
        return True
    finally:
        querier.undeclare()


def preferred(client: bytes, names: set[str]) -> list[str]:
    """Names in one client's order (rendezvous hashing): every follower is first for equally many clients.

    Joining and leaving changes nothing between the others.
    """
    return sorted(names, key=lambda name: hashlib.blake2b(client + name.encode(), digest_size=8).digest())


class Asker:
    """Queries followers and map server of one site; errors as in `Client`."""

    def __init__(self, session: zenoh.Session, endpoint: str, site: str, timeout_s: float) -> None:
        self._session, self._endpoint, self._site, self._timeout_s = session, endpoint, site, timeout_s
        self._followers = Followers(session, site)

    def ask(self, query: MapQuery[Any], *, at: Origin | None = None) -> Answered:
        """Query the map. at: origin of an earlier answer that this one continues."""
        wait_s = query.wait_s if query.after else 0.0
        wait_s += PAST_S if query.may_read_journal else 0.0
        if at and at.follower:
            return self._of_follower(query, at.follower)
        return self._get(query, wait_s)

    def followers(self) -> list[FollowerState]:
        """Followers that answer readably, by name."""
        states = []
        for name in sorted(self._followers.look()):  # routers allow no wildcard for a name
            key = keys.follower_query(self._site, name, AliveQuery.name)
            answered = self._once(_Attempt(key, {}, name), self._timeout_s / 2)
            if isinstance(answered, Answered):
                with suppress(MessageError):
                    states.append(_state(decode_alive(answered.data), answered.origin))
        return states

    def command(self, key: str, parameters: Mapping[str, str], wait_s: float) -> bytes:
        """Have the server execute a command."""
        return self._until_answered(lambda: iter((_Attempt(key, parameters),)), wait_s).data

    def _of_follower(self, query: MapQuery[Any], follower: str) -> Answered:
        """Ask this follower only; QueryError `expired` if it is gone."""
        attempt = self._attempt(query, follower)
        outcome = self._once(attempt, self._timeout_s)
        if isinstance(outcome, Answered):
            return outcome
        self._followers.avoid(follower)
        if isinstance(outcome, QueryError) and outcome.reason not in ELSEWHERE:
            raise outcome
        raise QueryError(Refusal.EXPIRED, f"follower {follower} does not answer any more: ask again from the beginning")

    def _get(self, query: MapQuery[Any], wait_s: float) -> Answered:
        server = _Attempt(keys.map_query(self._site, query.name), query.parameters())

        def attempts() -> Iterator[_Attempt]:
            if query.ask_first is not AskFirst.FOLLOWER:
                yield server
            if query.ask_first is not AskFirst.SERVER_ALONE:
                for name in self._followers.in_order()[:FOLLOWERS_TRIED]:
                    yield self._attempt(query, name)
            if query.ask_first is AskFirst.FOLLOWER:
                yield server

        return self._until_answered(attempts, wait_s)

    def _attempt(self, query: MapQuery[Any], follower: str) -> _Attempt:
        parameters = query.parameters()
        if query.after:
            parameters["wait"] = text_of(min(query.wait_s, FOLLOWER_WAIT_S))
        return _Attempt(keys.follower_query(self._site, follower, query.name), parameters, follower)

    def _until_answered(self, attempts: Callable[[], Iterator[_Attempt]], wait_s: float) -> Answered:
        """Try one attempt after the other; time out when no process has held the query for timeout_s."""
        held_s, timed_out = time.monotonic(), False  # until when a process held it
        refusal: QueryError | None = None
        end_s = held_s + self._timeout_s + wait_s
        while (now_s := time.monotonic()) < min(end_s, held_s + self._timeout_s):
            for attempt in attempts():
                asked_s = time.monotonic()
                left_s = max(end_s - asked_s, AGAIN_S)
                outcome = self._once(attempt, left_s / 2 if attempt.follower else left_s)
                if isinstance(outcome, Answered):
                    return outcome
                if isinstance(outcome, QueryError):
                    self._go_on(attempt, outcome, end_s - time.monotonic())
                    held_s, refusal = time.monotonic(), outcome
                elif attempt.follower:
                    self._followers.avoid(attempt.follower)
                else:
                    timed_out = outcome is _Silence.TIMED_OUT
                    held_s = time.monotonic() if time.monotonic() > asked_s + AGAIN_S else held_s
            time.sleep(max(0.0, AGAIN_S - (time.monotonic() - now_s)))
        raise refusal or self._no_answer(timed_out=timed_out)

    def _go_on(self, attempt: _Attempt, refusal: QueryError, left_s: float) -> None:
        """Raise a refusal, unless another attempt may succeed: elsewhere, or soon."""
        if attempt.follower and refusal.reason in ELSEWHERE:
            return
        if attempt.follower or not 0 < refusal.retry_after_s < left_s - AGAIN_S:
            raise refusal
        time.sleep(refusal.retry_after_s)

    def _once(self, attempt: _Attempt, timeout_s: float) -> Answered | QueryError | _Silence:
        """Ask once. An unreadable follower, of another version say, counts as silent."""
        try:
            return self._heard(attempt, timeout_s)
        except MessageError:
            if attempt.follower:
                return _Silence.NOBODY
            raise

    def _heard(self, attempt: _Attempt, timeout_s: float) -> Answered | QueryError | _Silence:
        outcome: Answered | QueryError | _Silence = _Silence.NOBODY
        for reply in self._session.get(attempt.selector, timeout=timeout_s):
            if reply.ok is not None:
                return Answered(reply.ok.payload.to_bytes(), _origin(reply.ok.attachment))
            if reply.err is not None:
                text = reply.err.payload.to_bytes()
                outcome = _Silence.TIMED_OUT if text == TIMED_OUT else decode_error(text)
        return outcome

    def _no_answer(self, *, timed_out: bool) -> LinkError:
        site = self._site
        problem = f"no map server answers for site {site!r}: start one with `sitegrid server`, or check the name"
        if timed_out:
            problem = f"the map server of site {site!r} did not answer in time: it hangs, or has too much to do"
        if self._endpoint.startswith("tls/"):
            problem += "; or these keys may not ask this (see docs/security.md)"
        return LinkError(self._endpoint, problem)


def _origin(attachment: zenoh.ZBytes | None) -> Origin:
    return decode_origin(attachment.to_bytes()) if attachment else SERVER


def _state(alive: ServerAlive, origin: Origin) -> FollowerState:
    lag = (origin.behind_rows, origin.behind_s)
    return FollowerState(origin.follower, alive.store, alive.journalled, alive.merged, *lag)


def _name(key: str) -> str:
    """Follower of a token; empty if it is none."""
    try:
        return keys.follower_of(key)
    except ConfigError:
        return ""
