"""The web server's process: its address, TLS, and the event loop."""

from __future__ import annotations

import asyncio
import socket
import threading
from argparse import Namespace
from collections.abc import Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import uvicorn

from protocol.errors import ConfigError
from protocol.wire.credentials import CERTIFICATE_FILE, KEY_FILE
from sitegrid.client import connect
from sitegrid.process.lifetime import say
from sitegrid.security.tokens import TokenFile
from sitegrid.web.app import WebApp
from sitegrid.web.site import SiteFeed
from sitegrid.web.sockets import CONNECTIONS, TLS_S, Listening, PatientProtocol

MESSAGE_BYTES = 4096  # of what a page says
ADDRESS_BYTES = 2**18  # that are read, to be refused by name: a line of 10,000 places; beyond, the connection ends


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
    clients = [connect(endpoint, name, keys=arguments.keys) for name, endpoint in sites]

    async def run() -> None:
        if arguments.tls:  # uvicorn cannot be told how long a handshake may take
            loop: Any = asyncio.get_running_loop()
            loop.create_server = partial(loop.create_server, ssl_handshake_timeout=TLS_S, ssl_shutdown_timeout=TLS_S)
        web = WebApp([SiteFeed(client) for client in clients], person, listening.counts)
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
