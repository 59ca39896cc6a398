"""Input from strangers: connections to the web server, and archives with valid seals."""

from __future__ import annotations

import asyncio
import io
import re
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache, partial
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from hypothesis import strategies as st
from hypothesis.strategies import DrawFn, SearchStrategy
from uvicorn.config import Config
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.server import ServerState

from protocol.errors import LinkError
from protocol.queries.answer_codec import decode_info
from sitegrid.web.app import WebApp
from sitegrid.web.openapi import PREFIX
from sitegrid.web.resources import RESOURCES
from sitegrid.web.site import SiteFeed
from tests.fuzz.mutations import damaged, files, texts
from tests.fuzz.verdict import Decoder
from tests.golden.make import FOLDER

SITE = "paper"
HEAD = " HTTP/1.1\r\nHost: localhost\r\nOrigin: http://localhost\r\nIf-None-Match: *\r\nContent-Length: 0\r\n\r\n"
ASKED = ("/", "/healthz", "/metrics", f"{PREFIX}/sites/{SITE}/xyz/value/resistance/14/8500/5500.png?token=a")
PARAMETERS = "x=1&y=2&lat=49&lon=8&bounds=0,0,9,9&layers=visits&from=1&to=2026-01-01T00:00:00Z&format=npz&line=1,2;3,4"
LIVE = f"GET {PREFIX}/sites/{SITE}/live?store=a&row=1&fact=2 HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\n"
LIVE += "Connection: Upgrade\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n"
SAID = (
    b'\x81\x94\0\0\0\0{"row": 1, "fact":2}',
    b"\x89\x81\0\0\0\0p\x88\x82\0\0\0\0\x03\xe8",
    b"\x01\x81\0\0\0\0{\x80\x81\0\0\0\0}",
)
OWN = (500, 501, 505)  # statuses that blame the server
TURNS = 200  # of the event loop, for an answer
ODD = (0, -1, 1, 2**31, 2**62, 1e300, -1e300, np.nan, np.inf, 1e-320)


def web() -> Iterator[Decoder]:
    """Decoders of whole connections; the map server only answers `info`."""
    paths = (*ASKED, *(f"{PREFIX}/sites/{SITE}/{name}?{PARAMETERS}" for name in RESOURCES))
    yield Decoder("http", tuple(f"GET {path}{HEAD}".encode() for path in paths), partial(_connect, b""), (), texts)
    yield Decoder("frames", SAID, partial(_connect, LIVE.encode()), (), files)


class _NoServer:
    """A client whose map server only answers `info`."""

    site = SITE

    def __getattr__(self, name: str) -> Callable[..., Any]:
        def ask(*_: object, **__: object) -> Any:
            if name == "info":
                return decode_info((FOLDER / "info.bin").read_bytes())
            raise LinkError(SITE, "no answer")

        return ask


class _Wire(asyncio.Transport):
    """The peer of a connection. sent: all answers."""

    def __init__(self) -> None:
        super().__init__({"peername": ("127.0.0.1", 1), "sockname": ("127.0.0.1", 2)})
        self.sent, self.protocol, self._closes = b"", None, False

    def write(self, data: bytes) -> None:  # type: ignore[override]
        self.sent += data

    def set_protocol(self, protocol: Any) -> None:
        self.protocol = protocol

    def close(self) -> None:
        self._closes = True

    abort = close

    def is_closing(self) -> bool:
        return self._closes

    def pause_reading(self) -> None: ...
    def resume_reading(self) -> None: ...


@cache
def _server() -> tuple[asyncio.AbstractEventLoop, Config]:
    async def nothing() -> None: ...

    loop, feed = asyncio.new_event_loop(), SiteFeed(_NoServer())  # type: ignore[arg-type]
    feed._follow = nothing  # type: ignore[method-assign]
    app = WebApp([feed], None, Counter(), ("localhost",), {}).app
    config = Config(app, ws="websockets-sansio", ws_max_size=4096, log_config=None, lifespan="off")
    config.load()
    return loop, config


def _connect(begin: bytes, data: bytes) -> None:
    """Send this on a connection; AssertionError if the server blames itself."""
    loop, config = _server()
    wire, wrong = _Wire(), list[Any]()
    loop.set_exception_handler(lambda _, context: wrong.append(context))
    loop.run_until_complete(_say(wire, config, (begin, data)))
    statuses = [int(text) for text in re.findall(rb"HTTP/1\.1 (\d{3}) ", wire.sent)]
    assert not wrong, wrong[0].get("exception") or wrong[0]
    assert not set(statuses) & set(OWN), f"{statuses}"
    assert b"\x88\x02\x03\xf3" not in wire.sent, "1011: an error of the server"


async def _say(wire: _Wire, config: Config, parts: tuple[bytes, ...]) -> None:
    state = ServerState()
    wire.protocol = H11Protocol(config, state, {})
    wire.protocol.connection_made(wire)
    for part in parts:
        if part and not wire.is_closing():
            wire.protocol.data_received(part)
        for _ in range(TURNS):
            await asyncio.sleep(0)
            if wire.sent and not part:
                break
    wire.protocol.connection_lost(None)
    if state.tasks:
        await asyncio.wait(state.tasks, timeout=5.0)
    assert not state.tasks, "a visitor who has left is still worked for"


def archives(seeds: tuple[bytes, ...]) -> SearchStrategy[bytes]:
    """Parquet files with other values, types, names or orders, some damaged too."""

    @st.composite
    def strategy(draw: DrawFn) -> bytes:
        table = pq.read_table(io.BytesIO(draw(st.sampled_from(seeds))))
        for _ in range(draw(st.integers(1, 3))):
            table = _changed(draw, table)
        out = io.BytesIO()
        statistics, rows = draw(st.sampled_from((True, True, True, False))), draw(st.sampled_from((1, 4, 2**20)))
        pq.write_table(table, out, write_statistics=statistics, row_group_size=rows)
        return draw(damaged(out.getvalue())) if draw(st.integers(0, 3)) == 0 else out.getvalue()

    return strategy()


def _changed(draw: DrawFn, table: Any) -> Any:
    at = draw(st.integers(0, table.num_columns - 1)) if table.num_columns else -1
    if at < 0:
        return table
    column, field = table.column(at), table.schema.field(at)
    match draw(st.sampled_from(("value", "value", "value", "type", "name", "drop", "order"))):
        case "value" if len(table):
            odd = ("", "../../x", "loader-1", "x" * 999) if pa.types.is_string(field.type) else ODD
            values = column.to_pylist()
            values[draw(st.integers(0, len(values) - 1))] = draw(st.sampled_from(odd))
            with suppress(pa.ArrowException, OverflowError):  # no value of this type
                return table.set_column(at, field, pa.array(values, field.type))
        case "type":
            return table.set_column(at, field.name, column.cast(pa.string()))
        case "name":
            return table.set_column(at, draw(st.sampled_from(("row", "x", "y" * 999))), column)
        case "drop":
            return table.remove_column(at)
        case "order":
            return table.take(pa.array(draw(st.permutations(range(len(table)))), pa.int64()))
    return table
