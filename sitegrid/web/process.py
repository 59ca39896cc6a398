"""The web server's process: TLS, event loop, request timeouts."""

from __future__ import annotations

import asyncio
import logging
import socket
import threading
from argparse import Namespace
from asyncio import sslproto
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from functools import partial
from http import HTTPStatus
from pathlib import Path
from typing import Any

import h11
import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from protocol.errors import ConfigError, LinkError
from protocol.wire.credentials import CERTIFICATE_FILE, KEY_FILE
from sitegrid.client import Client, connect
from sitegrid.process.supervisor import say_ready, until
from sitegrid.security.tokens import TokenFile
from sitegrid.web.app import WebApp
from sitegrid.web.backdrop import load_backdrops
from sitegrid.web.site import SiteFeed
from sitegrid.web.sockets import AT_ONCE, OF_ADDRESS, Listening, listen
from sitegrid.web.values import RequestProblem, problem_response

MESSAGE_BYTES = 4096  # of a page's message
ADDRESS_BYTES = 2**18  # of an address that is refused by name: a line of 10,000 places; longer ones end the connection
ROUTER_S = 1.0  # between attempts to reach a router
REQUEST_S = 10.0  # timeout of a request, from its first byte or the connection's start
TLS_S = 5.0  # timeout of a handshake
TLS_BYTES = 2**15  # receive buffer per connection; a TLS record has half of it

log = logging.getLogger("sitegrid.web.process")


def serve(
    opened: ExitStack,
    sites: Sequence[tuple[str | None, str]],
    address: tuple[str, int],
    arguments: Namespace,
    stop: threading.Event,
) -> int:
    """Serve sites, each a name (None: see `connect`) and an endpoint, until `stop` is set."""
    listening = opened.enter_context(listen(address))
    person = TokenFile(arguments.tokens).person if arguments.tokens else None
    secured = _tls(arguments.tls)
    backdrops = load_backdrops(arguments.config) if arguments.config else {}
    names = {name.lower() for name in (address[0], socket.gethostname(), *arguments.hosts)}
    clients: list[Client] = []
    for name, endpoint in sites:
        if (client := _connected(endpoint, name, arguments.keys, stop)) is None:
            return 0
        clients.append(client)
    shown = [client.site for client in clients]
    if others := sorted(set(backdrops) - set(shown)):
        raise ConfigError(arguments.config, f"site `{others[0]}` is not shown; shown: {', '.join(shown)}")

    logging.getLogger("uvicorn.error").addFilter(_without_traceback)

    async def run() -> None:
        if arguments.tls:  # uvicorn has no options for handshake timeout and buffer
            sslproto.SSLProtocol.max_size = TLS_BYTES
            loop: Any = asyncio.get_running_loop()
            loop.create_server = partial(loop.create_server, ssl_handshake_timeout=TLS_S, ssl_shutdown_timeout=TLS_S)
        web = WebApp([SiteFeed(client) for client in clients], person, listening.counts, names, backdrops)
        config = uvicorn.Config(
            web.app,
            http=partial(PatientProtocol, listening),  # type: ignore[arg-type] # a factory
            ws="websockets-sansio",
            ws_max_size=MESSAGE_BYTES,
            h11_max_incomplete_event_size=ADDRESS_BYTES,
            backlog=AT_ONCE,
            log_config=None,
            log_level="error",  # a line per bad request would fill disks
            access_log=False,
            server_header=False,
            timeout_graceful_shutdown=1,
            **secured,
        )
        server = uvicorn.Server(config)
        watch = asyncio.create_task(_stop_with(server, stop))
        scheme, (host, port) = "https" if arguments.tls else "http", listening.getsockname()[:2]
        url = f"{scheme}://{f'[{host}]' if ':' in host else host}:{port}/"
        say_ready({"ready": "web", "url": url, "sites": shown})
        await server._serve([listening])  # noqa: SLF001 - `serve` would take the signals that stop_flag has
        stop.set()
        await watch

    asyncio.run(run())
    return 0


def _connected(endpoint: str, name: str | None, keys: Path | None, stop: threading.Event) -> Client | None:
    """A site's client once its router is there; None if `stop` is set first."""
    problem = ""
    while not stop.is_set():
        try:
            return connect(endpoint, name, keys=keys)
        except LinkError as error:
            if str(error) != problem:
                problem = str(error)
                log.warning("waiting for the router problem=%r", problem)
            stop.wait(ROUTER_S)
    return None


def _without_traceback(record: logging.LogRecord) -> bool:
    """Uvicorn logs a visitor's invalid text like an error of its own."""
    if record.msg == "Invalid UTF-8 sequence received from client.":
        record.exc_info = None
    return True


async def _stop_with(server: uvicorn.Server, stop: threading.Event) -> None:
    is_stopped = until(stop)
    while not is_stopped():
        await asyncio.sleep(0.2)
    server.should_exit = True


def _tls(folder: Path | None) -> dict[str, Any]:
    if folder is None:
        return {}
    for name in (CERTIFICATE_FILE, KEY_FILE):
        if not (folder / name).is_file():
            raise ConfigError(folder, f"holds no {name}")
    return {"ssl_certfile": str(folder / CERTIFICATE_FILE), "ssl_keyfile": str(folder / KEY_FILE)}


class PatientProtocol(H11Protocol):
    """HTTP/1.1 with a timeout for every request."""

    def __init__(self, listening: Listening, **given: Any) -> None:
        super().__init__(**given)
        self._listening = listening
        self._deadline: asyncio.TimerHandle | None = None

    def connection_made(self, transport: Any) -> None:
        """Start a connection and its first timeout."""
        super().connection_made(transport)
        self._connection = self._listening.connection(transport.get_extra_info("socket").fileno())
        if not self._connection.has_place:
            self._refuse()
        self._wait()

    def _refuse(self) -> None:
        self._listening.refuse(self._connection.origin)
        detail = f"too many connections; an address may have {OF_ADDRESS}: close some"
        close = {"Connection": "close"}
        self.app = problem_response(RequestProblem(HTTPStatus.TOO_MANY_REQUESTS, "too_many", detail, close))

    def data_received(self, data: bytes) -> None:
        """Continue or start a request and its timeout."""
        super().data_received(data)
        if self.conn.their_state in (h11.IDLE, h11.SEND_BODY):
            self._wait()
            return
        self._listening.waits(self._connection, now=False)
        self._cork(1)
        if self._deadline:
            self._deadline.cancel()
            self._deadline = None

    def on_response_complete(self) -> None:
        """Flush an answer."""
        self._cork(0)
        self._listening.waits(self._connection, now=True)
        super().on_response_complete()

    def pause_writing(self) -> None:
        """Note that the peer is slow."""
        self._listening.waits(self._connection, now=True)
        super().pause_writing()

    def resume_writing(self) -> None:
        """Resume an answer."""
        self._listening.waits(self._connection, now=False)
        super().resume_writing()

    def _cork(self, on: int) -> None:
        """Send head and body together where supported: small answers come in one piece."""
        with suppress(AttributeError, OSError):
            self.transport.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_CORK, on)

    def _wait(self) -> None:
        self._deadline = self._deadline or self.loop.call_later(REQUEST_S, self._give_up)

    def _give_up(self) -> None:
        if not self._connection.is_live:
            self._listening.counts["refused_slow"] += 1
            self.transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        """End a connection."""
        if self._deadline:
            self._deadline.cancel()
        super().connection_lost(exc)

    def _should_upgrade(self) -> bool:
        """Limit WebSockets; others get a refusal."""
        if not super()._should_upgrade():
            return False
        self._connection.is_live = self._listening.has_room_for_live(self._connection)
        if not self._connection.is_live:
            self._refuse()
        self._listening.waits(self._connection, now=False)
        return self._connection.is_live
