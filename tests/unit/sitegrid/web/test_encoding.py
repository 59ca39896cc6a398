"""Answers in pieces: the same JSON, quick pieces, bounded room."""

from __future__ import annotations

import asyncio
import json
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from protocol.errors import QueryError
from sitegrid.web import encoding
from sitegrid.web.encoding import PIECE, Cache, Large, Room, answered, pieces
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


def test_a_large_answer_has_its_room_until_it_is_sent_or_not_taken(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(encoding, "LARGE_S", 0.05)
    monkeypatch.setattr(encoding, "WHOLE", 2)
    room = Room(10)

    async def serve(parts: list[bytes], *, takes: bool) -> None:
        response = await answered(iter(parts), "text/plain", room.take(7))
        assert isinstance(response, Large)

        async def receive() -> Any:
            await asyncio.Event().wait()

        async def send(message: Any) -> None:
            if message.get("body"):
                with pytest.raises(QueryError, match="ask again later, or for less"):
                    room.take(4)
                if not takes:
                    await asyncio.Event().wait()

        await response({"type": "http", "method": "GET", "headers": []}, receive, send)
        room.take(10)()

    for parts, takes in (([b"1"], True), ([b"1", b"2", b"3"], True), ([b"1", b"2"], False)):
        asyncio.run(serve(parts, takes=takes))


def test_the_newest_values_are_kept_that_have_room_together():
    cache: Cache[bytes] = Cache(10, len)
    for key in (1, 1, 2, 3):
        cache.keep(key, bytes(4))
    assert list(cache) == [2, 3]
    cache.keep(4, bytes(11))
    assert not cache
