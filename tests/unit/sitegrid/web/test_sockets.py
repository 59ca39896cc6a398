"""A visitor's sockets: number and timeouts, shortened here."""

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
from sitegrid.web import process, sockets
from sitegrid.web.process import PatientProtocol
from sitegrid.web.sockets import Listening, origin_of

WHOLE = b"GET / HTTP/1.1\r\nHost: x\r\n\r\n"
BODY = b"POST / HTTP/1.1\r\nHost: x\r\nContent-Length: 999\r\n\r\n"
UPGRADE = b"GET / HTTP/1.1\r\nHost: x\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
UPGRADE += b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n"
PATIENCE_S = 0.4


@pytest.fixture(autouse=True)
def _short_times_and_few_places(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(process, "REQUEST_S", PATIENCE_S)
    for name, value in {"OF_ADDRESS": 4, "LIVE": 0.75, "SPARE": 2}.items():
        monkeypatch.setattr(sockets, name, value)


async def app(scope: Scope, receive: Receive, send: Send) -> None:
    """Answers, or begins to, and holds WebSockets."""
    if scope["path"] == "/endless":
        await send({"type": "http.response.start", "status": 200, "headers": []})
        await send({"type": "http.response.body", "body": b"1", "more_body": True})
        while (await receive())["type"] != "http.disconnect":
            pass
    elif scope["type"] == "http":
        await PlainTextResponse("ok\n")(scope, receive, send)
    else:
        await send({"type": "websocket.accept"})
        while (await receive())["type"] != "websocket.disconnect":
            pass


@contextlib.contextmanager
def serving(most: int = 500) -> Iterator[Listening]:
    with Listening(socket.AF_INET, most) as listening:
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
    """Start of an answer; empty if closed."""
    try:
        visitor.sendall(request)
        return visitor.recv(1000)[9:12]
    except ConnectionError:
        return b""


def has_ended(visitor: socket.socket, trickle: bytes = b"") -> bool:
    """Wait for the server to close; a trickle of bytes buys no time."""
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


@pytest.mark.parametrize("kind", [b"", b"GET / HT", WHOLE, UPGRADE, WHOLE + b"GET / HTTP/1.1\r\nX: "])
@pytest.mark.parametrize("addresses", [1, 4])
def test_sockets_that_wait_make_room_for_who_asks(kind: bytes, addresses: int, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(process, "REQUEST_S", 60.0)
    with serving(most=8) as listening, contextlib.ExitStack() as stack:
        for number in range(30):
            visitor = stack.enter_context(opened(listening, f"127.0.0.{2 + number % addresses}"))
            with contextlib.suppress(ConnectionError):
                visitor.sendall(kind)
        for address in ("127.0.0.2", "127.0.0.9"):
            with opened(listening, address) as other:
                assert asked(other) == b"200"
        assert listening.counts["ended_waiting"] > 10 or kind == UPGRADE


def test_an_address_has_so_many_sockets_that_are_answered(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(process, "REQUEST_S", 60.0)
    with serving() as listening, contextlib.ExitStack() as stack:
        live, second, third = (stack.enter_context(opened(listening, "127.0.0.2")) for _ in range(3))
        assert (asked(live, UPGRADE), asked(second, UPGRADE), asked(third, UPGRADE)) == (b"101",) * 3
        assert asked(stack.enter_context(opened(listening, "127.0.0.2")), UPGRADE) == b"429", "a part of the places"
        busy = stack.enter_context(opened(listening, "127.0.0.2"))
        assert asked(busy, WHOLE.replace(b"/", b"/endless", 1)) == b"200"
        assert asked(stack.enter_context(opened(listening, "127.0.0.2"))) == b"429"
        assert asked(stack.enter_context(opened(listening, "127.0.0.3"))) == b"200", "another one finds a place"
        assert listening.counts["refused_connections"] >= 2


def test_all_addresses_of_a_host_are_one_origin():
    assert origin_of("192.0.2.7") != origin_of("192.0.2.8")
    assert origin_of("::ffff:192.0.2.7") != origin_of("::ffff:192.0.2.8")
    assert origin_of("2001:db8::1") == origin_of("2001:db8::ffff:1") != origin_of("2001:db8:0:1::1")
    assert origin_of("fe80::1%eth0") == origin_of("fe80::2%eth0")
