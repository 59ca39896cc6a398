"""Answers in pieces: the same JSON, quick pieces, bounded room."""

from __future__ import annotations

import asyncio
import json
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from starlette.responses import Response

from protocol.errors import QueryError
from sitegrid.web import encoding
from sitegrid.web.encoding import PIECE, Cache, Column, Large, Room, answered, in_room, pieces
from sitegrid.web.values import plain


@dataclass(frozen=True)
class Part:
    stamp_ns: int
    line: tuple[tuple[float, float], ...]


WIDE = np.random.default_rng(1).random((300, 700)).astype(np.float32)
WIDE[::7, ::3] = np.nan
VALUES: list[Any] = [
    {},
    [],
    None,
    "a, b",
    Part(10**18, ((0.5, float("nan")), (2.0, 3.0))),
    {"a": [Part(0, ()), Part(1, ((1.0, 2.0),))], "b_ns": 1, "c": [[]], "d": np.zeros((0, 3)), "e": [None, {}]},
    {"layers": {"x": WIDE, "y": WIDE[0], "n": np.arange(5000)}, "steps": [{"i": i} for i in range(9000)]},
]


@pytest.mark.parametrize("value", VALUES)
def test_pieces_are_the_json_of_the_whole_and_small(value: Any):
    parts = list(pieces(value))
    assert b"".join(parts) == json.dumps(plain(value)).encode()
    assert max(map(len, parts)) < 2 * PIECE
    assert b"".join(pieces(iter([value]))) == json.dumps([plain(value)]).encode()


@pytest.fixture
def room(monkeypatch: pytest.MonkeyPatch) -> Room:
    """Room for ten bytes; answers of a byte are large."""
    for name, value in {"LARGE_S": 0.05, "WHOLE": 2, "PIECE": 0}.items():
        monkeypatch.setattr(encoding, name, value)
    room = Room(10)
    monkeypatch.setattr(encoding, "ROOM", room)
    return room


@pytest.mark.parametrize(("parts", "takes"), [([b"1"], True), ([b"1", b"2", b"3"], True), ([b"1", b"2"], False)])
def test_a_large_answer_has_its_room_until_it_is_sent_or_not_taken(room: Room, parts: list[bytes], takes: bool):
    async def receive() -> Any:
        await asyncio.Event().wait()

    async def send(message: Any) -> None:
        if message.get("body"):
            with pytest.raises(QueryError, match="ask again later, or for less"):
                room.take(4)
            if not takes:
                await asyncio.Event().wait()

    async def serve() -> None:
        response = await in_room(7 - min(2, len(parts)), lambda: answered(iter(parts), "text/plain"))
        assert isinstance(response, Large)
        await response({"type": "http", "method": "GET", "headers": []}, receive, send)
        room.take(10)()

    asyncio.run(serve())


def test_an_answer_that_fails_or_is_small_leaves_its_room_and_one_that_is_too_large_takes_all(room: Room):
    async def failing() -> Response:
        raise QueryError("internal", "no answer")

    async def serve() -> None:
        with pytest.raises(QueryError, match="no answer"):
            await in_room(7, failing)
        await in_room(7, lambda: answered(iter([b""]), "text/plain"))
        done = room.take(10**9)
        with pytest.raises(QueryError, match="ask again later"):
            await in_room(1, failing)
        done()
        room.take(10)()

    asyncio.run(serve())


def test_a_column_is_its_arrays_one_after_the_other():
    arrays = [np.zeros(0), np.arange(3.0), np.array([np.nan]), np.zeros((0,))]
    assert json.loads(b"".join(pieces({"x": Column(iter(arrays)), "y": 1}))) == {"x": [0.0, 1.0, 2.0, None], "y": 1}


def test_the_newest_values_are_kept_that_have_room_together():
    cache: Cache[bytes] = Cache(10, len)
    for key in (1, 1, 2, 3):
        cache.keep(key, bytes(4))
    assert list(cache) == [2, 3]
    cache.keep(4, bytes(11))
    assert not cache
