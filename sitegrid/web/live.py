"""Live connection of a page: always the current map, never a queue.

A page states its version and gets the difference. The next follows once it is acknowledged, so slow pages get newer
maps less often, at no memory cost.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import Callable
from typing import Any

from starlette.websockets import WebSocket, WebSocketDisconnect

from protocol.queries.answers import MapVersion
from sitegrid.web.encoding import beside, frame
from sitegrid.web.site import POSES_S, SiteFeed

TAKEN_S = 30.0  # a page that acknowledges nothing for this long is disconnected; it reconnects
QUIET_S = 1.0  # longest interval between poses
NO_PERMISSION, TOO_SLOW = 4401, 4408
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
        if self._sent is None and not feed.is_away and (answer := feed.since(self._version)):
            if answer.tiles or answer.whole:
                self._sent, self._sent_s = answer.version, now_s
                await self._timely(socket.send_bytes(await beside(frame, answer)))
            else:
                self._version = answer.version  # nothing on the page differs
        if now_s - self._poses_s >= 0.9 * POSES_S and (poses := feed.poses_text()):
            self._poses_s = now_s
            await self._timely(socket.send_text(poses))

    async def _timely(self, sending: Any) -> None:
        """Send, or give up on a stalled page."""
        try:
            await asyncio.wait_for(sending, TAKEN_S)
        except TimeoutError:
            raise WebSocketDisconnect(TOO_SLOW) from None


def _version(parameters: Any) -> MapVersion | None:
    """The version from an earlier connection, or None."""
    try:
        return MapVersion(str(parameters["store"]), int(parameters["row"]), int(parameters["fact"]))
    except (KeyError, ValueError):
        return None
