"""Live connection of a page: always the current map, never a queue.

A page states its version and gets the difference, in parts. The next follows once one is acknowledged, so slow pages
get newer maps less often, at the memory of one part.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

from starlette.websockets import WebSocket, WebSocketDisconnect

from protocol.queries.answers import MapVersion
from protocol.queries.map_tiles import MapTile, TilesAnswer
from sitegrid.web.encoding import beside, framed
from sitegrid.web.site import POSES_S, SiteFeed

TAKEN_S = 30.0  # a page that acknowledges nothing for this long is disconnected; it reconnects
QUIET_S = 1.0  # longest interval between poses
NO_PERMISSION, TOO_SLOW = 4401, 4408
PART_BYTES = 2**18  # of tiles per message: 250 pages that take nothing hold 64 MB
AWAY = json.dumps({"state": "away"})


async def serve(socket: WebSocket, feed: SiteFeed) -> None:
    """Serve one page until it leaves or stalls."""
    await socket.accept()
    page = _Page(socket, feed, _version(socket.query_params))
    async with feed.watched():
        tasks = [asyncio.create_task(page.receive()), asyncio.create_task(page.send())]
        done, rest = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        for task in rest:
            task.cancel()
        for task in (*done, *rest):
            with contextlib.suppress(asyncio.CancelledError, WebSocketDisconnect, RuntimeError):
                await task


class _Page:
    """One page. version: the map it acknowledged."""

    def __init__(self, socket: WebSocket, feed: SiteFeed, version: MapVersion | None) -> None:
        self._socket, self._door, self._version = socket, feed, version
        self._may_stay: Callable[[], bool] = socket.scope.get("may_stay", lambda: True)  # see Guard
        self._sent: MapVersion | None = None  # in flight
        self._parts: deque[TilesAnswer] = deque()  # of a difference, to be sent
        self._sent_s = 0.0
        self._taken: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._state = ""
        self._poses_s = -QUIET_S

    async def receive(self) -> None:
        """Receive acknowledged versions."""
        while True:
            try:
                table = json.loads(await self._socket.receive_text())  # KeyError for bytes
                said = int(table["row"]), int(table["fact"])
            except (ValueError, KeyError, TypeError, OverflowError, RecursionError):
                await self._socket.close(1007, "row and fact are expected")
                return
            if self._sent and said == (self._sent.row, self._sent.fact):
                self._version, self._sent = self._sent, None
                self._taken.set_result(None)

    async def send(self) -> None:
        """Send news as it arises."""
        feed, loop = self._door, asyncio.get_running_loop()
        while True:
            now_s = loop.time()
            if self._sent and now_s - self._sent_s > TAKEN_S:
                await self._socket.close(TOO_SLOW, "nothing was taken in")
                return
            if not self._may_stay():
                await self._socket.close(NO_PERMISSION, "the token no longer counts")
                return
            moved, self._taken = feed.moved, loop.create_future()  # before sending, so that no news is missed
            await self._send_news(now_s)
            await asyncio.wait([moved, self._taken], timeout=QUIET_S, return_when=asyncio.FIRST_COMPLETED)

    async def _send_news(self, now_s: float) -> None:
        feed, socket = self._door, self._socket
        state = AWAY if feed.is_away else feed.state_text or "{}"
        if state != self._state:
            self._state = state
            await self._timely(socket.send_text(state))
        if not self._parts and self._sent is None and not feed.is_away and (answer := feed.since(self._version)):
            if answer.tiles or answer.whole:
                self._parts.extend(parts_of(answer, self._version))
            else:
                self._version = answer.version  # nothing on the page differs
        if self._parts and self._sent is None:
            part = self._parts.popleft()
            self._sent, self._sent_s = part.version, now_s
            await self._timely(socket.send_bytes(await beside(lambda: b"".join(framed(part)))))
        if now_s - self._poses_s >= 0.9 * POSES_S and (poses := feed.poses_text()):
            self._poses_s = now_s
            await self._timely(socket.send_text(poses))

    async def _timely(self, sending: Any) -> None:
        """Send, or give up on a stalled page."""
        try:
            await asyncio.wait_for(sending, TAKEN_S)
        except TimeoutError:
            raise WebSocketDisconnect(TOO_SLOW) from None


def parts_of(answer: TilesAnswer, known: MapVersion | None) -> Iterator[TilesAnswer]:
    """A difference in messages of about PART_BYTES.

    All but the last have the version before, so that a page that leaves in between gets the rest.
    """
    before = MapVersion(answer.version.store, 0, 0) if answer.whole or known is None else known
    tiles: list[MapTile] = []
    whole, size = answer.whole, 0
    for tile in answer.tiles:
        if size >= PART_BYTES:
            yield replace(answer, version=before, whole=whole, tiles=tuple(tiles))
            whole, size = False, 0
            tiles.clear()
        tiles.append(tile)
        size += len(tile.planes)
    yield replace(answer, whole=whole, tiles=tuple(tiles))


def _version(parameters: Any) -> MapVersion | None:
    """The version from an earlier connection, or None."""
    try:
        return MapVersion(str(parameters["store"]), int(parameters["row"]), int(parameters["fact"]))
    except (KeyError, ValueError):
        return None
