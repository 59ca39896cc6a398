"""One visitor's sockets: how many there may be, and how long each may take. Times are short here."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import threading
from collections.abc import Iterator
from functools import partial
from typing import Any

import pytest
import uvicorn
from starlette.responses import PlainTextResponse
from starlette.types import Receive, Scope, Send

from sitegrid.process.children import wait_until
from sitegrid.web import process
from sitegrid.web.process import Listening, PatientProtocol, origin_of

WHOLE = b"GET / HTTP/1.1\r\nHost: x\r\n\r\n"
BODY = b"POST / HTTP/1.1\r\nHost: x\r\nContent-Length: 999\r\n\r\n"
UPGRADE = b"GET / HTTP/1.1\r\nHost: x\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
UPGRADE += b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n"
PATIENCE_S = 0.4


@pytest.fixture(autouse=True)
def _short_times_and_few_places(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in {"REQUEST_S": PATIENCE_S, "OF_ADDRESS": 3, "SPARE": 2}.items():
        monkeypatch.setattr(process, name, value)


async def app(scope: Scope, receive: Receive, send: Send) -> None:
    """Answers a request, and takes a WebSocket until it goes."""
    if scope["type"] == "http":
        await PlainTextResponse("ok\n")(scope, receive, send)
    else:
        await send({"type": "websocket.accept"})
        while (await receive())["type"] != "websocket.disconnect":
            pass


@contextlib.contextmanager
def serving() -> Iterator[Listening]:
    with Listening(socket.AF_INET) as listening:
        listening.bind(("127.0.0.1", 0))
        http: Any = partial(PatientProtocol, listening)
        config = uvicorn.Config(app, http=http, ws="websockets-sansio", lifespan="off", log_config=None)
        server = uvicorn.Server(config)
        thread = threading.Thread(target=lambda: asyncio.run(server._serve([listening])))
        thread.start()
        try:
            wait_until(lambda: server.started, 10, "the server")
            yield listening
        finally:
            server.should_exit = server.force_exit = True
            thread.join()


def opened(listening: Listening, address: str = "127.0.0.1") -> socket.socket:
    return socket.create_connection(listening.getsockname(), 10, source_address=(address, 0))


def asked(visitor: socket.socket, request: bytes = WHOLE) -> bytes:
    """How an answer begins; empty where the connection is closed."""
    try:
        visitor.sendall(request)
        return visitor.recv(1000)[9:12]
    except ConnectionError:
        return b""


def has_ended(visitor: socket.socket, trickle: bytes = b"") -> bool:
    """Wait until the server closes a connection, and send a byte now and then: it buys no time."""
    visitor.settimeout(PATIENCE_S / 4)
    for _ in range(40):
        try:
            if not visitor.recv(1000):
                return True
        except TimeoutError:
            visitor.sendall(trickle)
        except ConnectionError:
            return True
    return False


@pytest.mark.parametrize("begun", [b"", b"GET / HT", WHOLE + b"GET / HTTP/1.1\r\nX: ", BODY])
def test_a_request_that_does_not_come_in_whole_ends_its_connection(begun: bytes):
    with serving() as listening, opened(listening) as slow:
        slow.sendall(begun)
        assert has_ended(slow, b"1" if begun else b"")
        assert listening.counts == {"refused_slow": 1}
        with opened(listening) as other:
            assert asked(other) == b"200"


def test_an_address_has_so_many_sockets_whatever_they_are(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(process, "REQUEST_S", 60.0)
    with serving() as listening, contextlib.ExitStack() as stack:
        first, live, third, fourth, fifth, *more = (
            stack.enter_context(opened(listening, "127.0.0.2")) for _ in range(9)
        )
        assert asked(live, UPGRADE) == b"101"
        assert (asked(fourth), asked(fifth, UPGRADE)) == (b"429", b"429"), "a WebSocket is a socket"
        assert b"" in map(asked, more), "to be told takes a place too"
        assert (asked(first), asked(third)) == (b"200", b"200"), "those that came first stay"
        assert asked(stack.enter_context(opened(listening, "127.0.0.3"))) == b"200", "another one finds a place"
        for each in (first, third):
            each.close()
        wait_until(lambda: asked(stack.enter_context(opened(listening, "127.0.0.2"))) == b"200", 10, "a free place")
        assert listening.counts["refused_connections"] >= 3


def test_all_addresses_of_a_host_are_one_origin():
    assert origin_of("192.0.2.7") != origin_of("192.0.2.8")
    assert origin_of("::ffff:192.0.2.7") != origin_of("::ffff:192.0.2.8")
    assert origin_of("2001:db8::1") == origin_of("2001:db8::ffff:1") != origin_of("2001:db8:0:1::1")
    assert origin_of("fe80::1%eth0") == origin_of("fe80::2%eth0")
