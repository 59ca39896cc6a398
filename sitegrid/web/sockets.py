"""Sockets of the web server: how many an address may have, and how long each may keep others waiting.

What a socket says is worked on by uvicorn. Here it is counted when it is accepted, before TLS, so that whatever it
becomes (a handshake that never begins, half a request, a WebSocket) counts until it is closed.
"""

from __future__ import annotations

import asyncio
import logging
import socket
import time
from collections import Counter
from http import HTTPStatus
from ipaddress import ip_address
from typing import Any

import h11
import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from sitegrid.web.problems import Problem, problem_response

CONNECTIONS = 500
# Sockets of one address: 28 browsers behind one NAT that load the page at the same time (six sockets each, and the live
# one), or 200 pages that are open behind a proxy; and two such addresses leave places to others.
OF_ADDRESS = 200
SPARE = 50  # more sockets of an address and in all: to say that there are too many takes one
REQUEST_S = 10.0  # for a request to come in whole, from its first byte or the connection's begin
TLS_S = 5.0  # for a handshake, three round trips
STALLED_S = 30.0  # until a socket that takes nothing is closed
LOG_S = 10.0  # between two lines about refused sockets
TOO_MANY = Problem(
    HTTPStatus.TOO_MANY_REQUESTS,
    "too_many",
    f"this address has more than {OF_ADDRESS} connections; close some",
    {"Connection": "close", "Retry-After": f"{REQUEST_S:.0f}"},
)
_RECEIVING = (h11.IDLE, h11.SEND_BODY)  # states of who sends a request that is not whole
log = logging.getLogger("sitegrid.web")


class Listening(socket.socket):
    """A listening socket that closes at once what it has no room for. counts: of what was refused."""

    def __init__(self, family: socket.AddressFamily) -> None:
        super().__init__(family)
        self.counts: Counter[str] = Counter()
        self._accepted: list[tuple[str, socket.socket]] = []
        self._logged_s = -LOG_S

    def accept(self) -> tuple[socket.socket, Any]:
        """As a socket's own; ConnectionAbortedError, which the event loop passes over, where there is no room."""
        connection, address = super().accept()
        origin = origin_of(address[0])
        if self.open_of(origin) >= OF_ADDRESS + SPARE or len(self._accepted) >= CONNECTIONS + SPARE:
            connection.close()
            self.refuse(origin)
            raise ConnectionAbortedError
        if hasattr(socket, "TCP_USER_TIMEOUT"):  # of Linux: nothing else ends a peer that answers and takes nothing
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, round(STALLED_S * 1e3))
        self._accepted.append((origin, connection))
        return connection, address

    def open_of(self, origin: str) -> int:
        """How many sockets of an origin are open."""
        self._accepted = [one for one in self._accepted if one[1].fileno() >= 0]
        return sum(one[0] == origin for one in self._accepted)

    def has_place(self, origin: str, number: int) -> bool:
        """Whether a socket, by its file's number, is among those that its origin may have: the first ones."""
        numbers = (one[1].fileno() for one in self._accepted if one[0] == origin)
        return number in [one for one in numbers if one >= 0][:OF_ADDRESS]

    def refuse(self, origin: str) -> None:
        """Count a socket that is refused, and name where it comes from."""
        self.counts["refused_connections"] += 1
        if (now_s := time.monotonic()) - self._logged_s > LOG_S:
            self._logged_s = now_s
            own, every = self.open_of(origin), len(self._accepted)
            log.warning("too many connections address=%s open=%d of_all=%d", origin, own, every)


def origin_of(host: str) -> str:
    """Whose address it is: one host has all of an IPv6 network of 64 bits."""
    address = ip_address(host.partition("%")[0])
    if address.version == 6:
        return str(address.ipv4_mapped or ip_address(int(address) >> 64 << 64))
    return str(address)


class JoinedWrites:
    """A transport that sends what is written in one turn of the loop together: a small answer comes in one piece."""

    def __init__(self, transport: asyncio.Transport, loop: asyncio.AbstractEventLoop) -> None:
        self._transport, self._loop = transport, loop
        self._parts: list[bytes] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self._transport, name)

    def write(self, data: bytes) -> None:
        """Send it with what else is written until the loop's next turn."""
        if not self._parts:
            self._loop.call_soon(self._flush)
        self._parts.append(data)

    def close(self) -> None:
        """Close it once all is sent."""
        self._flush()
        self._transport.close()

    def _flush(self) -> None:
        parts, self._parts = self._parts, []
        if parts:
            self._transport.write(b"".join(parts))


class PatientProtocol(H11Protocol):
    """HTTP/1.1 with an end to patience: a connection whose next request does not come in whole in time is closed."""

    def __init__(self, listening: Listening, **given: Any) -> None:
        super().__init__(**given)
        self._listening, self._has_place = listening, True
        self._deadline: asyncio.TimerHandle | None = None

    def connection_made(self, transport: Any) -> None:
        """Begin a connection, and the time that its first request has."""
        super().connection_made(JoinedWrites(transport, self.loop))  # type: ignore[arg-type]
        origin = origin_of(self.client[0]) if self.client else ""
        self._has_place = self._listening.has_place(origin, transport.get_extra_info("socket").fileno())
        if not self._has_place:
            self._listening.refuse(origin)
            self.app = problem_response(TOO_MANY)
        self._wait()

    def data_received(self, data: bytes) -> None:
        """Go on with a request, or begin one, and the time that it has."""
        super().data_received(data)
        if self.conn.their_state in _RECEIVING:
            self._wait()
        elif self._deadline:
            self._deadline.cancel()
            self._deadline = None

    def _wait(self) -> None:
        self._deadline = self._deadline or self.loop.call_later(REQUEST_S, self._give_up)

    def _give_up(self) -> None:
        if self.transport.get_protocol() is self and not self.transport.is_closing():  # it may be a WebSocket's by now
            self._listening.counts["refused_slow"] += 1
            self.transport.abort()

    def _should_upgrade(self) -> bool:
        """WebSockets are connections too; what is not upgraded is told that there are too many."""
        return self._has_place and len(self.connections) < CONNECTIONS and super()._should_upgrade()


class PatientServer(uvicorn.Server):
    """uvicorn on a socket of ours."""

    def __init__(self, config: uvicorn.Config, listening: Listening) -> None:
        super().__init__(config)
        self._listening = listening

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """As uvicorn's own, which cannot be told how long a handshake may take."""
        await super().startup(sockets or [])
        config, tls_s = self.config, TLS_S if self.config.ssl else None
        given = {"config": config, "server_state": self.server_state, "app_state": self.lifespan.state}
        self.servers = [
            await asyncio.get_running_loop().create_server(
                lambda: PatientProtocol(self._listening, **given),
                sock=self._listening,
                backlog=config.backlog,
                ssl=config.ssl,
                ssl_handshake_timeout=tls_s,
                ssl_shutdown_timeout=tls_s,
            )
        ]
