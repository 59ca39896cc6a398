"""One site as its pages see it: a client of its map server, and what all pages share of it."""

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
PERIOD_S = 0.1  # between two questions for what changed, while somebody looks: what did not change costs little
POSES_S = 0.2  # between two times that pages are told where machines are
STATE_S = 2.0  # between two questions for machines, changes and times
LINGER_S = 10.0  # the map is followed so much longer than somebody looks: GIS ask every few seconds
HEARD_S = 1.5  # machines publish their poses several times a second
THREADS = 8  # questions at once: more visitors wait for each other, not on the map server
PATIENT_THREADS = 4  # questions at once that may take seconds: these keep no other visitor waiting
PAST_BYTES = 2**26  # of maps of the past that are kept ready: a hundred of a usual site, so that a slider moves


class SiteFeed:
    """Asks one site's map server for all pages together. Its methods are for the event loop's thread.

    watchers: how many look at it now. is_away: whether the map server did not answer the last time.
    """

    def __init__(self, client: Client) -> None:
        self.client, self.name = client, client.site
        self.tiles: dict[tuple[int, int], MapTile] = {}
        self.answer: TilesAnswer | None = None
        self.state_text = ""  # what pages are told; empty until the map server has answered
        self.is_away = False
        self._moved: asyncio.Future[None] | None = None
        self._woken: tuple[Any, ...] = (None, False, "", 0)  # when pages were woken last, at this time
        self._woken_s = 0.0
        self._threads = ThreadPoolExecutor(THREADS, thread_name_prefix=f"ask-{client.site}")
        self._patient = ThreadPoolExecutor(PATIENT_THREADS, thread_name_prefix=f"much-{client.site}")
        self.watchers = 0
        self._task: asyncio.Task[None] | None = None
        self._looking: asyncio.Task[None] | None = None
        self._machines = Machines()
        self._listener: Listener[Pose] | None = None
        self._health: Listener[Health] | None = None
        self._listens_s = 0.0  # since when, of the event loop's clock
        self._known: tuple[frozenset[tuple[int, int]], MapVersion | None] = frozenset(), None
        self._info: tuple[float, MapInfo] | None = None
        self._projection: Projection | None = None
        self._poses_text: tuple[float, str] = -math.inf, ""
        self._past: Cache[TilesAnswer] = Cache(PAST_BYTES, _tiles_bytes)

    async def ask(self, question: Callable[..., T], *arguments: Any, **named: Any) -> T:
        """Ask the map server from a thread: the client waits for its answer."""
        return await _run(self._threads, question, *arguments, **named)

    async def ask_for_much(self, question: Callable[..., T], *arguments: Any, **named: Any) -> T:
        """As `ask`, for what takes the map server long: large areas, routes, the past."""
        return await _run(self._patient, question, *arguments, **named)

    async def answer_to(self, query: MapQuery[T]) -> T:
        """The map server's answer to a query."""
        is_long = query.is_long or query.reads_past or isinstance(query, RegionQuery)
        return await (self.ask_for_much if is_long else self.ask)(self.client.ask, query)

    async def info(self, most_s: float = STATE_S) -> MapInfo:
        """State of the map, at most so old."""
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
        """The map as of a time, kept ready while no sample that is older can have come in."""
        info = await self.info()
        key = as_of_ns, info.store, info.fact
        if key in self._past:
            self._past.move_to_end(key)
            return self._past[key]
        answer = await self.answer_to(TilesQuery(as_of_ns=as_of_ns))
        if as_of_ns < info.stamp_ns - 60 * 10**9:  # samples that are a minute late are rare, and show after a while
            self._past.keep(key, answer)
        return answer

    @property
    def moved(self) -> asyncio.Future[None]:
        """Done when tiles, poses or the state are others: what does not change wakes no page."""
        if self._moved is None or self._moved.done():
            self._moved = asyncio.get_running_loop().create_future()
        return self._moved

    async def known_tiles(self) -> frozenset[tuple[int, int]]:
        """Columns and rows of the map's tiles that have any ground."""
        known, version = self._known
        answer = await self.ask_for_much(self.client.ask, TilesQuery(version))
        new = frozenset((tile.x, tile.y) for tile in answer.tiles)
        self._known = new if answer.whole else known | new, answer.version
        return self._known[0]

    def since(self, version: MapVersion | None) -> TilesAnswer | None:
        """What a page that has a version needs to have the newest one; None while no map is known."""
        if self.answer is None:
            return None
        now = self.answer.version
        whole = version is None or version.store != now.store or version.row > now.row or version.fact > now.fact
        if version == now:
            return self.answer if not self.answer.whole else replace(self.answer, whole=False)
        tiles = [tile for tile in self.tiles.values() if version is None or whole or _is_newer(tile, version)]
        return replace(self.answer, whole=whole, tiles=tuple(tiles))

    def poses(self) -> list[dict[str, Any]]:
        """Newest pose of each machine that said anything lately, and how old it is."""
        return self._machines.poses()

    def reports(self) -> list[dict[str, Any]]:
        """What each machine that spoke lately says of itself."""
        return self._machines.reports()

    def poses_text(self) -> str:
        """The poses as pages are told of them, made once for all; empty for none."""
        now_s = time.monotonic()
        if now_s - self._poses_text[0] >= PERIOD_S:
            poses = self.poses()
            self._poses_text = now_s, json.dumps({"poses": poses}) if poses else ""
        return self._poses_text[1]

    async def heard(self) -> None:
        """Wait until a machine says where it is, but no longer than HEARD_S since somebody listens."""
        loop = asyncio.get_running_loop()
        end_s = (self._listens_s or loop.time()) + HEARD_S
        while not self._machines and (left_s := end_s - loop.time()) > 0:
            await asyncio.wait([self.moved], timeout=left_s)

    @contextlib.asynccontextmanager
    async def watched(self) -> Any:
        """While somebody looks, the map is asked for what changed."""
        self.watchers += 1
        if self._task is None:
            self._task = asyncio.create_task(self._follow())
        try:
            yield
        finally:
            self.watchers -= 1

    async def close(self) -> None:
        """End everything."""
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
        """Ask again and again while somebody looks; ends when nobody does."""
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
        """Say soon that there is no map server: the first question to it waits longer for one that starts again."""
        with contextlib.suppress(zenoh.ZError):  # the session was closed meanwhile
            is_there = await self.ask(is_answered, self.client.session, keys.map_query(self.name, "tiles"))
            self.is_away |= not is_there and self.answer is None
            self._notify()

    def _notify(self) -> None:
        """Wake the pages where there is anything new to show; for poses five times a second."""
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
        """Where each machine was while somebody looked, oldest first."""
        return self._machines.tracks()

    @property
    def refused(self) -> Mapping[str, int]:
        """How many poses were not believed, by reason."""
        return dict(self._listener.refused) if self._listener else {}

    def _pose(self, key: str, data: bytes) -> Pose:
        return receive_pose(key, data, self._info[1].site.extent_m if self._info else MAX_EXTENT_M)


async def _run(threads: ThreadPoolExecutor, question: Callable[..., T], *arguments: Any, **named: Any) -> T:
    return await asyncio.get_running_loop().run_in_executor(threads, partial(question, *arguments, **named))


def _live_text(name: str, info: MapInfo, machines: Iterable[MachineState], changes: Iterable[GroundChange]) -> str:
    """What pages are told of a site whose map server answers."""
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
    """The health report of the machine that its key names."""
    health = decode_health(data)
    if not key.endswith(f"/machine/{health.machine}/health"):
        raise MessageError(Refusal.WRONG_MACHINE, f"{health.machine!r} sends under {key}", field="machine")
    return health


def _is_newer(tile: MapTile, version: MapVersion) -> bool:
    return tile.row > version.row or tile.fact > version.fact
