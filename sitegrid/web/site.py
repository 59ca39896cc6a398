"""One site for all its pages: a client of its map server, and shared state."""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import time
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Any, TypeVar

import zenoh

from protocol.errors import LinkError, MessageError, QueryError, Refusal
from protocol.queries.answers import GroundChange, MachineState, MapInfo, MapVersion
from protocol.queries.map_tiles import MapTile, TilesAnswer, TilesQuery
from protocol.queries.request import MapQuery
from protocol.queries.requests import ChangesQuery, InfoQuery, MachinesQuery, RegionQuery
from protocol.site.site_config import MAX_EXTENT_M, Projection
from protocol.wire import keys
from protocol.wire.codec import decode_health, receive_pose
from protocol.wire.messages import Health, Pose
from sitegrid.client import Client
from sitegrid.features.feature import projection_of
from sitegrid.follower_choice import is_answered
from sitegrid.listener import Listener
from sitegrid.trust_sentences import rolls
from sitegrid.web.encoding import Cache
from sitegrid.web.machines import Machines
from sitegrid.web.values import plain

T = TypeVar("T")
PERIOD_S = 0.1  # between queries for changes while somebody looks; unchanged maps are cheap
POSES_S = 0.2  # between pose updates
STATE_S = 2.0  # between queries for machines, changes and times
LINGER_S = 10.0  # the map is followed this long after the last visit: GIS ask every few seconds
HEARD_S = 1.5  # machines publish poses several times a second
THREADS = 8  # concurrent queries; excess visitors wait here, not on the map server
PATIENT_THREADS = 4  # concurrent slow queries, which delay no other visitor
PAST_BYTES = 2**26  # cache of past maps: a hundred of a usual site, for a slider


class SiteFeed:
    """Queries one site's map server for all pages. Methods run on the event loop's thread.

    watchers: current visitors. is_away: the map server's last query failed.
    """

    def __init__(self, client: Client) -> None:
        self.client, self.name = client, client.site
        self.tiles: dict[tuple[int, int], MapTile] = {}
        self.answer: TilesAnswer | None = None
        self.state_text = ""  # empty until the map server has answered
        self.is_away = False
        self._moved: asyncio.Future[None] | None = None
        self._woken: tuple[Any, ...] = (None, False, "", 0)  # state and time of the last wake-up
        self._woken_s = 0.0
        self._threads = ThreadPoolExecutor(THREADS, thread_name_prefix=f"ask-{client.site}")
        self._patient = ThreadPoolExecutor(PATIENT_THREADS, thread_name_prefix=f"much-{client.site}")
        self.watchers = 0
        self._task: asyncio.Task[None] | None = None
        self._looking: asyncio.Task[None] | None = None
        self._machines = Machines()
        self._listener: Listener[Pose] | None = None
        self._health: Listener[Health] | None = None
        self._listens_s = 0.0  # since when, on the loop's clock
        self._known: tuple[frozenset[tuple[int, int]], MapVersion | None] = frozenset(), None
        self._info: tuple[float, MapInfo] | None = None
        self._projection: Projection | None = None
        self._poses_text: tuple[float, str] = -math.inf, ""
        self._past: Cache[TilesAnswer] = Cache(PAST_BYTES, _tiles_bytes)

    async def ask(self, question: Callable[..., T], *arguments: Any, **named: Any) -> T:
        """Query the map server on a thread, because the client blocks."""
        return await _run(self._threads, question, *arguments, **named)

    async def ask_for_much(self, question: Callable[..., T], *arguments: Any, **named: Any) -> T:
        """Like `ask`, for slow queries: large areas, routes, the past."""
        return await _run(self._patient, question, *arguments, **named)

    async def answer_to(self, query: MapQuery[T]) -> T:
        """The map server's answer to a query."""
        is_long = query.is_long or query.reads_past or isinstance(query, RegionQuery)
        return await (self.ask_for_much if is_long else self.ask)(self.client.ask, query)

    async def info(self, most_s: float = STATE_S) -> MapInfo:
        """Map state, at most most_s old."""
        now_s = time.monotonic()
        if self._info is None or now_s - self._info[0] > most_s:
            self._info = now_s, await self.answer_to(InfoQuery())
        return self._info[1]

    async def projection(self) -> Projection:
        """From latitude and longitude to the site's frame."""
        if self._projection is None:
            self._projection = projection_of((await self.info()).site)
        return self._projection

    async def tiles_as_of(self, as_of_ns: int) -> TilesAnswer:
        """The map as of a time, cached if older samples are unlikely."""
        info = await self.info()
        key = as_of_ns, info.store, info.fact
        if key in self._past:
            self._past.move_to_end(key)
            return self._past[key]
        answer = await self.answer_to(TilesQuery(as_of_ns=as_of_ns))
        if as_of_ns < info.stamp_ns - 60 * 10**9:  # samples a minute late are rare; they show after a while
            self._past.keep(key, answer)
        return answer

    @property
    def moved(self) -> asyncio.Future[None]:
        """Done when tiles, poses or state change."""
        if self._moved is None or self._moved.done():
            self._moved = asyncio.get_running_loop().create_future()
        return self._moved

    async def known_tiles(self) -> frozenset[tuple[int, int]]:
        """Columns and rows of tiles with any ground."""
        known, version = self._known
        answer = await self.ask_for_much(self.client.ask, TilesQuery(version))
        new = frozenset((tile.x, tile.y) for tile in answer.tiles)
        self._known = new if answer.whole else known | new, answer.version
        return self._known[0]

    def since(self, version: MapVersion | None) -> TilesAnswer | None:
        """The difference from a page's version; None without a map."""
        if self.answer is None:
            return None
        now = self.answer.version
        whole = version is None or version.store != now.store or version.row > now.row or version.fact > now.fact
        if version == now:
            return self.answer if not self.answer.whole else replace(self.answer, whole=False)
        tiles = [tile for tile in self.tiles.values() if version is None or whole or _is_newer(tile, version)]
        return replace(self.answer, whole=whole, tiles=tuple(tiles))

    def poses(self) -> list[dict[str, Any]]:
        """Newest pose of each recent machine, and its age."""
        return self._machines.poses()

    def reports(self) -> list[dict[str, Any]]:
        """Status of each recent machine."""
        return self._machines.reports()

    def poses_text(self) -> str:
        """Poses as sent to pages, shared; empty if none."""
        now_s = time.monotonic()
        if now_s - self._poses_text[0] >= PERIOD_S:
            poses = self.poses()
            self._poses_text = now_s, json.dumps({"poses": poses}) if poses else ""
        return self._poses_text[1]

    async def heard(self) -> None:
        """Wait for a first pose, at most HEARD_S from the start of listening."""
        loop = asyncio.get_running_loop()
        end_s = (self._listens_s or loop.time()) + HEARD_S
        while not self._machines and (left_s := end_s - loop.time()) > 0:
            await asyncio.wait([self.moved], timeout=left_s)

    @contextlib.asynccontextmanager
    async def watched(self) -> Any:
        """Follow the map while the block runs."""
        self.watchers += 1
        if self._task is None:
            self._task = asyncio.create_task(self._follow())
        try:
            yield
        finally:
            self.watchers -= 1

    async def close(self) -> None:
        """Release everything."""
        if self._task:
            self._task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._task
        await asyncio.get_running_loop().run_in_executor(None, self._close)

    def _close(self) -> None:
        for listener in (self._listener, self._health):
            if listener:
                listener.close()
        self.client.close()
        for threads in (self._threads, self._patient):
            threads.shutdown(wait=False, cancel_futures=True)

    async def _follow(self) -> None:
        """Query changes while anybody looks."""
        if self._listener is None:
            key = keys.poses_all(self.name)
            self._listener = await self.ask(Listener, self.client.session, key, self._pose, self._machines.on_pose)
            key = keys.health_all(self.name)
            self._health = await self.ask(Listener, self.client.session, key, receive_health, self._machines.on_health)
            self._listens_s = asyncio.get_running_loop().time()
            self._looking = asyncio.create_task(self._look_for_server())
        next_state_s = 0.0
        idle_s = 0.0
        while idle_s < LINGER_S:
            began_s = time.monotonic()
            try:
                self._take(await self.answer_to(TilesQuery(self.answer.version if self.answer else None)))
                self._notify()  # the map first
                if began_s >= next_state_s:
                    next_state_s = began_s + STATE_S
                    self.state_text = await self.ask(_live_text, self.name, *await self._ask_state())
                self.is_away = False
            except (LinkError, QueryError, MessageError):
                self.is_away, next_state_s = True, 0.0
            self._notify()
            await asyncio.sleep(max(0.05, PERIOD_S - (time.monotonic() - began_s)))
            idle_s = 0.0 if self.watchers else idle_s + PERIOD_S
        self._task = None

    async def _look_for_server(self) -> None:
        """Soon report a missing map server; a first query waits longer for a restarting one."""
        with contextlib.suppress(zenoh.ZError):  # the session was closed meanwhile
            is_there = await self.ask(is_answered, self.client.session, keys.map_query(self.name, "tiles"))
            self.is_away |= not is_there and self.answer is None
            self._notify()

    def _notify(self) -> None:
        """Wake pages on news; for poses five times a second."""
        now_s, version = time.monotonic(), self.answer.version if self.answer else None
        heard = self._machines.heard if now_s - self._woken_s >= POSES_S else self._woken[-1]
        if (news := (version, self.is_away, self.state_text, heard)) != self._woken:
            self._woken, self._woken_s = news, now_s
            self.moved.set_result(None)

    def _take(self, answer: TilesAnswer) -> None:
        if answer.whole:
            self.tiles.clear()
        self.tiles |= {(tile.x, tile.y): tile for tile in answer.tiles}
        self.answer = replace(answer, tiles=())

    async def _ask_state(self) -> tuple[MapInfo, Any, Any]:
        info = await self.info(0.0)
        machines = (await self.answer_to(MachinesQuery())).machines
        changes = (await self.answer_to(ChangesQuery())).changes
        self._machines.on_findings({machine.name: said for machine in machines if (said := rolls(machine))})
        return info, machines, changes

    def tracks(self) -> dict[str, list[Pose]]:
        """Tracks since somebody looks, oldest first."""
        return self._machines.tracks()

    @property
    def refused(self) -> Mapping[str, int]:
        """Refused poses by reason."""
        return dict(self._listener.refused) if self._listener else {}

    def _pose(self, key: str, data: bytes) -> Pose:
        return receive_pose(key, data, self._info[1].site.extent_m if self._info else MAX_EXTENT_M)


async def _run(threads: ThreadPoolExecutor, question: Callable[..., T], *arguments: Any, **named: Any) -> T:
    return await asyncio.get_running_loop().run_in_executor(threads, partial(question, *arguments, **named))


def _live_text(name: str, info: MapInfo, machines: Iterable[MachineState], changes: Iterable[GroundChange]) -> str:
    """State of a site as sent to pages."""
    site = {
        "name": name,
        "stamp_ns": info.stamp_ns,
        "first_ns": info.first_ns,
        "boundaries": list(info.boundaries),
        "trusted": {machine.name: machine.trusted for machine in machines},
        "changes": [plain(change) for change in changes],
    }
    return json.dumps({"state": "live", "site": site})


def _tiles_bytes(answer: TilesAnswer) -> int:
    return sum(len(tile.planes) for tile in answer.tiles)


def receive_health(key: str, data: bytes) -> Health:
    """Health report of the machine named by its key."""
    health = decode_health(data)
    if not key.endswith(f"/machine/{health.machine}/health"):
        raise MessageError(Refusal.WRONG_MACHINE, f"{health.machine!r} sends under {key}", field="machine")
    return health


def _is_newer(tile: MapTile, version: MapVersion) -> bool:
    return tile.row > version.row or tile.fact > version.fact
