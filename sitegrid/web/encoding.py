"""Encode answers off the event loop: few threads, in pieces, at the client's pace.

Python runs one thread at a time, so encoding a long text at once would block the loop from any thread.
"""

from __future__ import annotations

import asyncio
import json
import struct
from collections import OrderedDict
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from dataclasses import asdict, fields, is_dataclass
from functools import partial
from itertools import chain
from typing import Any, TypeVar

import numpy as np
from starlette.responses import Response, StreamingResponse
from starlette.types import Receive, Scope, Send

from protocol.arrays import AnyArray
from protocol.errors import QueryError, Refusal
from protocol.queries.map_tiles import PLANES, MapTile, TilesAnswer
from sitegrid.web.values import plain, with_times

T = TypeVar("T")
THREADS = 2  # more would only wait for each other
PIECE = 2**16  # characters, encoded in 2 ms
WHOLE = 2**22  # bytes: shorter answers have a length, which some programs need (GDAL)
AT_ONCE = 2000  # numbers, formatted in 1 ms
LARGE_S = 300.0  # timeout of a large answer: 64 MB at 2 Mbit/s
_pool = ThreadPoolExecutor(THREADS, thread_name_prefix="encode")


async def beside(work: Callable[..., T], *arguments: Any) -> T:
    """Run CPU work on one of a few threads."""
    return await asyncio.get_running_loop().run_in_executor(_pool, partial(work, *arguments))


async def as_json(value: Any, media: str = "application/json") -> Response:
    """Records, arrays, tables, lists, columns and iterators as JSON."""
    return await answered(pieces(value), media)


async def answered(parts: Iterator[bytes], media: str) -> Response:
    """An answer in parts; long ones are encoded while sent."""
    first = await beside(_begin, parts)
    if len(first) <= PIECE:
        return Response(first, media_type=media)
    response = Large(chain((first,), parts), media)
    response.hold(len(first))
    if len(first) < WHOLE:
        response.headers["Content-Length"] = str(len(first))
    return response


async def in_room(size: int, making: Callable[[], Awaitable[Response]]) -> Response:
    """Make a response that holds `size` bytes until it is sent; QueryError without room."""
    done = ROOM.take(size)
    try:
        response = await making()
    except BaseException:
        done()
        raise
    if isinstance(response, Large):
        response.at_end(done)
    else:
        done()
    return response


def _begin(parts: Iterator[bytes]) -> bytes:
    """The answer's first WHOLE bytes."""
    first = bytearray()
    while len(first) < WHOLE and (part := next(parts, b"")):
        first += part
    return bytes(first)


async def _made(texts: Iterator[bytes]) -> AsyncIterator[bytes]:
    while (text := await beside(next, texts, None)) is not None:
        yield text


class Column(Iterator[AnyArray]):
    """A long list of numbers in arrays (n,), made one after the other."""

    def __init__(self, arrays: Iterator[AnyArray]) -> None:
        self._arrays = arrays

    def __next__(self) -> AnyArray:
        """The next array with any."""
        return next(array for array in self._arrays if len(array))


def pieces(value: Any) -> Iterator[bytes]:
    """JSON of a value, as by `plain`, in pieces of about PIECE; at least one."""
    texts, size = [], 0
    for text in _texts(value):
        texts.append(text)
        size += len(text)
        if size >= PIECE:
            yield "".join(texts).encode()
            texts, size = [], 0
    yield "".join(texts).encode()


def _texts(value: Any) -> Iterator[str]:
    """JSON in parts that are quick to make."""
    if is_dataclass(value) and not isinstance(value, type):
        value = {field.name: getattr(value, field.name) for field in fields(value)}
    if isinstance(value, Mapping):
        yield "{"
        for i, (key, item) in enumerate(with_times(value).items()):
            yield f"{', ' if i else ''}{json.dumps(str(key))}: "
            yield from _texts(item)
        yield "}"
    elif isinstance(value, np.ndarray | list | tuple | Iterator):
        yield "["
        for i, part in enumerate(_parts(value)):
            yield ", " if i else ""
            yield from part
        yield "]"
    else:
        yield json.dumps(plain(value), allow_nan=False)


def _parts(value: Any) -> Iterator[Iterator[str]]:
    """A list's content: many numbers at once, containers one by one."""
    if isinstance(value, Column):
        yield from chain.from_iterable(map(_parts, value))
        return
    if isinstance(value, Iterator) or (len(value) and not isinstance(value, np.ndarray) and _holds_more(value[0])):
        yield from map(_texts, value)
        return
    width = value.size // max(1, len(value)) if isinstance(value, np.ndarray) else 1
    step = max(1, AT_ONCE // max(1, width))
    for first in range(0, len(value), step):
        yield iter([json.dumps(plain(value[first : first + step]), allow_nan=False)[1:-1]])


def _holds_more(item: Any) -> bool:
    return isinstance(item, Mapping | list | tuple | np.ndarray | Iterator) or is_dataclass(item)


def framed(answer: TilesAnswer) -> Iterator[bytes]:
    """Tiles for a page: length of a JSON head (4 bytes, big-endian), head, deflated planes."""
    head = {
        "store": answer.version.store,
        "row": answer.version.row,
        "fact": answer.version.fact,
        "stamp_ns": answer.stamp_ns,
        "cell_m": answer.cell_m,
        "whole": answer.whole,
        "planes": list(PLANES),
        "scales": {name: asdict(scale) for name, scale in PLANES.items()},
        "tiles": [_head(tile) for tile in answer.tiles],
    }
    text = json.dumps(head, separators=(",", ":")).encode()
    return chain((struct.pack(">I", len(text)), text), (tile.planes for tile in answer.tiles))


def _head(tile: MapTile) -> dict[str, Any]:
    numbers = {"x": tile.x, "y": tile.y, "row": tile.row, "fact": tile.fact, "newest_ns": tile.newest_ns}
    return {**numbers, "bytes": len(tile.planes)}


class Room:
    """Bounded room for large answers in flight, in the caller's unit."""

    def __init__(self, most: int) -> None:
        self._most = self._free = most

    def take(self, size: int) -> Callable[[], None]:
        """Take room; returns its release. QueryError if there is too little. On the loop's thread.

        What exceeds all room takes all of it.
        """
        size = min(size, self._most)
        if size > self._free:
            raise QueryError(Refusal.OVERLOADED, "too many large answers are being taken; ask again later, or for less")
        self._free -= size

        def give_back() -> None:
            self._free += size

        return give_back


ROOM = Room(2**27)  # bytes, for all visitors


class Large(StreamingResponse):
    """A large answer, cut off for slow clients."""

    def __init__(self, texts: Iterator[bytes], media: str) -> None:
        super().__init__(_made(texts), media_type=media)
        self._ends = ExitStack()

    def at_end(self, done: Callable[[], None]) -> None:
        """Call `done` once it is sent, or given up."""
        self._ends.callback(done)

    def hold(self, size: int) -> None:
        """Take room until the end; QueryError if there is too little."""
        self.at_end(ROOM.take(size))

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send it."""
        with self._ends, suppress(TimeoutError):
            await asyncio.wait_for(super().__call__(scope, receive, send), LARGE_S)


class Cache(OrderedDict[Any, T]):
    """Cache of the newest values, bounded in bytes."""

    def __init__(self, most: int, size: Callable[[T], int]) -> None:
        super().__init__()
        self._most, self._size, self._used = most, size, 0

    def keep(self, key: Any, value: T) -> None:
        """Add a value unless present."""
        if key not in self:
            self[key] = value
            self._used += self._size(value)
        while self._used > self._most:
            self._used -= self._size(self.popitem(last=False)[1])
