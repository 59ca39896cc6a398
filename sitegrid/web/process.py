"""The web server's process: its address, TLS, event loop and sockets, and how long each may keep others waiting.

A socket is counted when it is accepted, before TLS, and until it is closed, whatever it becomes: a handshake that never
begins, half a request, a WebSocket.
"""

from __future__ import annotations

import asyncio
import logging
import socket
import threading
from argparse import Namespace
from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from functools import partial
from http import HTTPStatus
from ipaddress import ip_address, ip_network
from pathlib import Path
from typing import Any

import h11
import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from protocol.errors import ConfigError
from protocol.wire.credentials import CERTIFICATE_FILE, KEY_FILE
from sitegrid.client import connect
from sitegrid.process.lifetime import say
from sitegrid.security.tokens import TokenFile
from sitegrid.web.app import WebApp
from sitegrid.web.site import SiteFeed
from sitegrid.web.values import Problem, problem_response

MESSAGE_BYTES = 4096  # of what a page says
ADDRESS_BYTES = 2**18  # that are read, to be refused by name: a line of 10,000 places; beyond, the connection ends
CONNECTIONS = 500
# 28 browsers behind one NAT that load the page at the same time (six sockets each, and the live one), or 200 pages that
# are open behind a proxy; two such addresses leave places to others.
OF_ADDRESS = 200
SPARE = 50  # more of an address and in all, who are told that there are too many: beyond, a socket is closed at once
REQUEST_S = 10.0  # for a request to come in whole, from its first byte or the connection's begin
TLS_S = 5.0  # for a handshake
STALLED_S = 30.0  # until a socket that takes nothing is closed
log = logging.getLogger("sitegrid.web.process")


def serve(
    opened: ExitStack,
    sites: Sequence[tuple[str | None, str]],
    address: tuple[str, int],
    arguments: Namespace,
    stop: threading.Event,
) -> int:
    """Serve sites, each a name (see `connect` for None) and an endpoint, until `stop` is set."""
    listening = opened.enter_context(_listen(address))
    person = TokenFile(arguments.tokens).person if arguments.tokens else None
    names = {name.lower() for name in (address[0], socket.gethostname(), *arguments.hosts)}
    clients = [connect(endpoint, name, keys=arguments.keys) for name, endpoint in sites]

    logging.getLogger("uvicorn.error").addFilter(_without_traceback)

    async def run() -> None:
        if arguments.tls:  # uvicorn cannot be told how long a handshake may take
            loop: Any = asyncio.get_running_loop()
            loop.create_server = partial(loop.create_server, ssl_handshake_timeout=TLS_S, ssl_shutdown_timeout=TLS_S)
        web = WebApp([SiteFeed(client) for client in clients], person, listening.counts, names)
        config = uvicorn.Config(
            web.app,
            http=partial(PatientProtocol, listening),  # type: ignore[arg-type] # what makes protocols
            ws="websockets-sansio",
            ws_max_size=MESSAGE_BYTES,
            h11_max_incomplete_event_size=ADDRESS_BYTES,
            limit_concurrency=CONNECTIONS,
            log_config=None,
            access_log=False,
            server_header=False,
            timeout_graceful_shutdown=1,
            **_tls(arguments.tls),
        )
        server = uvicorn.Server(config)
        watch = asyncio.create_task(_stop_with(server, stop))
        scheme, (host, port) = "https" if arguments.tls else "http", listening.getsockname()[:2]
        url = f"{scheme}://{f'[{host}]' if ':' in host else host}:{port}/"
        say({"ready": "web", "url": url, "sites": [client.site for client in clients]})
        await server._serve([listening])  # noqa: SLF001 - `serve` would take the signals that stop_flag has
        stop.set()
        await watch

    asyncio.run(run())
    return 0


def _without_traceback(record: logging.LogRecord) -> bool:
    """Of a visitor's message that is no text, which uvicorn takes for an error of its own."""
    if record.msg == "Invalid UTF-8 sequence received from client.":
        record.exc_info = None
    return True


async def _stop_with(server: uvicorn.Server, stop: threading.Event) -> None:
    while not stop.is_set():
        await asyncio.sleep(0.2)
    server.should_exit = True


def _listen(address: tuple[str, int]) -> Listening:
    host, port = address[0].strip("[]"), address[1]
    listening = Listening(socket.AF_INET6 if ":" in host else socket.AF_INET)
    try:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.bind((host, port))
        listening.listen(256)
    except OSError as error:
        listening.close()
        raise ConfigError("--listen", f"cannot listen on {host}:{port}: {error.strerror}") from None
    return listening


def _tls(folder: Path | None) -> dict[str, Any]:
    if folder is None:
        return {}
    for name in (CERTIFICATE_FILE, KEY_FILE):
        if not (folder / name).is_file():
            raise ConfigError(folder, f"holds no {name}")
    return {"ssl_certfile": str(folder / CERTIFICATE_FILE), "ssl_keyfile": str(folder / KEY_FILE)}


class Listening(socket.socket):
    """A listening socket that closes at once what it has no room for. counts: of what was refused."""

    def __init__(self, family: socket.AddressFamily) -> None:
        super().__init__(family)
        self.counts: Counter[str] = Counter()
        self._accepted: list[tuple[str, socket.socket]] = []

    def accept(self) -> tuple[socket.socket, Any]:
        """As a socket's own; ConnectionAbortedError, which the event loop passes over, where there is no room."""
        connection, address = super().accept()
        origin = origin_of(address[0])
        if len(self.open_of(origin)) >= OF_ADDRESS + SPARE or len(self._accepted) >= CONNECTIONS + SPARE:
            connection.close()
            self.refuse(origin)
            raise ConnectionAbortedError
        if hasattr(socket, "TCP_USER_TIMEOUT"):  # of Linux: nothing else ends a peer that answers and takes nothing
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, round(STALLED_S * 1e3))
        self._accepted.append((origin, connection))
        return connection, address

    def open_of(self, origin: str) -> list[int]:
        """Numbers of the files of an origin's open sockets, in the order in which they came."""
        self._accepted = [one for one in self._accepted if one[1].fileno() >= 0]
        return [connection.fileno() for name, connection in self._accepted if name == origin]

    def refuse(self, origin: str) -> None:
        """Count a socket that is refused, and name where it comes from."""
        self.counts["refused_connections"] += 1
        if self.counts["refused_connections"].bit_count() == 1:  # the first, second, fourth...
            own, every = len(self.open_of(origin)), len(self._accepted)
            log.warning("too many connections address=%s open=%d of_all=%d", origin, own, every)


def origin_of(host: str) -> str:
    """Whose address it is: a host has all of an IPv6 network of 64 bits."""
    address = ip_address(host.partition("%")[0])
    is_alone = address.version == 4 or address.ipv4_mapped
    return host if is_alone else str(ip_network((int(address), 64), strict=False))


class PatientProtocol(H11Protocol):
    """HTTP/1.1 with an end to patience: a connection whose next request does not come in whole in time is closed."""

    def __init__(self, listening: Listening, **given: Any) -> None:
        super().__init__(**given)
        self._listening, self._has_place = listening, True
        self._deadline: asyncio.TimerHandle | None = None

    def connection_made(self, transport: Any) -> None:
        """Begin a connection, and the time that its first request has."""
        super().connection_made(transport)
        origin = origin_of(transport.get_extra_info("peername")[0])
        own = self._listening.open_of(origin)
        self._has_place = transport.get_extra_info("socket").fileno() in own[:OF_ADDRESS]
        if not self._has_place:
            self._listening.refuse(origin)
            detail, close = f"more than {OF_ADDRESS} connections of one address; close some", {"Connection": "close"}
            self.app = problem_response(Problem(HTTPStatus.TOO_MANY_REQUESTS, "too_many", detail, close))
        self._wait()

    def data_received(self, data: bytes) -> None:
        """Go on with a request, or begin one, and the time that it has."""
        super().data_received(data)
        if self.conn.their_state in (h11.IDLE, h11.SEND_BODY):
            self._wait()
            return
        self._cork(1)
        if self._deadline:
            self._deadline.cancel()
            self._deadline = None

    def on_response_complete(self) -> None:
        """Send what is left of an answer."""
        self._cork(0)
        super().on_response_complete()

    def _cork(self, on: int) -> None:
        """Have head and body of an answer leave together, where the system can: a small one comes in one piece."""
        with suppress(AttributeError, OSError):
            self.transport.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_CORK, on)

    def _wait(self) -> None:
        self._deadline = self._deadline or self.loop.call_later(REQUEST_S, self._give_up)

    def _give_up(self) -> None:
        if self.transport.get_protocol() is self and not self.transport.is_closing():  # it may be a WebSocket's by now
            self._listening.counts["refused_slow"] += 1
            self.transport.abort()

    def _should_upgrade(self) -> bool:
        """WebSockets are connections too; what is not upgraded is told that there are too many."""
        return self._has_place and len(self.connections) < CONNECTIONS and super()._should_upgrade()
