"""One site as its pages see it: a client of its map server, and what all pages share of it."""

from __future__ import annotations

import asyncio
import contextlib
import json
import struct
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, replace
from typing import Any, TypeVar

import zenoh

from protocol.errors import LinkError, MessageError, QueryError, Refusal
from protocol.queries.answers import MapInfo, MapVersion
from protocol.queries.map_tiles import PLANES, MapTile, TilesAnswer
from protocol.site.site_config import MAX_EXTENT_M, Projection, SiteConfig
from protocol.wire import keys
from protocol.wire.codec import decode_health, receive_pose
from protocol.wire.messages import Health, Pose
from sitegrid.asking import is_answered
from sitegrid.client import Client
from sitegrid.explanations import rolls
from sitegrid.health import faults_of
from sitegrid.listener import Listener
from sitegrid.web.values import plain

T = TypeVar("T")
PERIOD_S = 0.1  # between two questions for what changed, while somebody looks: what did not change costs little
STATE_S = 2.0  # between two questions for machines, changes and times
LINGER_S = 10.0  # the map is followed so much longer than somebody looks: GIS ask every few seconds
HEARD_S = 1.5  # machines publish their poses several times a second
MOST_POSES, TRACK_STEP_NS = 600, 10**9  # of a track: ten minutes of site time
SILENT_S = 120.0  # a machine that said nothing for so long is left out
THREADS = 8  # questions at once: more visitors wait for each other, not on the map server
PAST_KEPT = 128  # maps of the past that are kept ready: a day by minutes has more, a slider moves by fewer


class SiteFeed:
    """Asks one site's map server for all pages together. Its methods are for the event loop's thread.

    watchers: how many look at it now. is_away: whether the map server did not answer the last time.
    """

    def __init__(self, client: Client) -> None:
        self.client, self.name = client, client.site
        self.tiles: dict[tuple[int, int], MapTile] = {}
        self.answer: TilesAnswer | None = None
        self.state: dict[str, Any] = {}
        self.state_text = "{}"
        self.is_away = False
        self.moved = asyncio.Condition()  # notified when tiles, poses or the state may be others
        self._threads = ThreadPoolExecutor(THREADS, thread_name_prefix=f"ask-{client.site}")
        self.watchers = 0
        self._task: asyncio.Task[None] | None = None
        self._looking: asyncio.Task[None] | None = None
        self._poses: dict[str, tuple[Pose, float]] = {}
        self._tracks: dict[str, deque[Pose]] = {}
        self._poses_lock = threading.Lock()
        self._faults: dict[str, list[str]] = {}  # of machines' sensors
        self._rolls: dict[str, list[str]] = {}  # machines that roll unlike the others
        self._listener: Listener[Pose] | None = None
        self._health: Listener[Health] | None = None
        self._info: tuple[float, MapInfo] | None = None
        self._projection: Projection | None = None
        self._past: OrderedDict[tuple[int, str, int], TilesAnswer] = OrderedDict()

    async def ask(self, question: Callable[..., T], *arguments: Any, **named: Any) -> T:
        """Ask the map server from a thread: the client waits for its answer."""
        loop = asyncio.get_running_loop()
        return await loop.run_in_executor(self._threads, lambda: question(*arguments, **named))

    async def info(self, most_s: float = STATE_S) -> MapInfo:
        """State of the map, at most so old."""
        now_s = time.monotonic()
        if self._info is None or now_s - self._info[0] > most_s:
            self._info = now_s, await self.ask(self.client.info)
        return self._info[1]

    async def projection(self) -> Projection:
        """From latitude and longitude to the site's frame."""
        if self._projection is None:
            self._projection = Projection(_site_of(await self.info()))
        return self._projection

    async def tiles_as_of(self, as_of_ns: int) -> TilesAnswer:
        """The map as of a time, kept ready while no sample that is older can have come in."""
        info = await self.info()
        key = as_of_ns, info.store, info.fact
        if key in self._past:
            self._past.move_to_end(key)
            return self._past[key]
        answer = await self.ask(self.client.tiles, as_of_ns=as_of_ns)
        if as_of_ns < info.stamp_ns - 60 * 10**9:  # samples that are a minute late are rare, and show after a while
            self._past[key] = answer
            while len(self._past) > PAST_KEPT:
                self._past.popitem(last=False)
        return answer

    def since(self, version: MapVersion | None) -> TilesAnswer | None:
        """What a page that has a version needs to have the newest one; None while no map is known."""
        if self.answer is None:
            return None
        now = self.answer.version
        whole = version is None or version.store != now.store or version.row > now.row or version.fact > now.fact
        tiles = [tile for tile in self.tiles.values() if version is None or whole or _is_newer(tile, version)]
        return replace(self.answer, whole=whole, tiles=tuple(tiles))

    def poses(self) -> list[dict[str, Any]]:
        """Newest pose of each machine that said anything lately, and how old it is."""
        now_s = time.monotonic()
        with self._poses_lock:
            self._poses = {name: item for name, item in self._poses.items() if now_s - item[1] < SILENT_S}
            poses, faults, rolls = list(self._poses.values()), self._faults, self._rolls
        said = {pose.machine: [*faults.get(pose.machine, []), *rolls.get(pose.machine, [])] for pose, _ in poses}
        return [
            plain({**asdict(pose), "age_s": round(now_s - came_s, 3), "faults": said[pose.machine]})
            for pose, came_s in poses
        ]

    async def heard(self) -> None:
        """Wait until a machine says where it is, for a moment."""
        loop = asyncio.get_running_loop()
        end_s = loop.time() + HEARD_S
        while not self._poses and (left_s := end_s - loop.time()) > 0:
            async with self.moved:
                with contextlib.suppress(asyncio.TimeoutError):
                    await asyncio.wait_for(self.moved.wait(), left_s)

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
        self._threads.shutdown(wait=False, cancel_futures=True)

    async def _follow(self) -> None:
        """Ask again and again while somebody looks; ends when nobody does."""
        if self._listener is None:
            key = keys.poses_all(self.name)
            self._listener = await self.ask(Listener, self.client.session, key, self._pose, self._on_pose)
            key = keys.health_all(self.name)
            self._health = await self.ask(Listener, self.client.session, key, receive_health, self._on_health)
            self._looking = asyncio.create_task(self._look_for_server())
        next_state_s = 0.0
        idle_s = 0.0
        while idle_s < LINGER_S:
            began_s = time.monotonic()
            try:
                self._take(await self.ask(self.client.tiles, self.answer.version if self.answer else None))
                await self._notify()  # the map first
                if began_s >= next_state_s:
                    next_state_s = began_s + STATE_S
                    self.state = await self._ask_state()
                    self.state_text = json.dumps(self.state)
                self.is_away = False
            except (LinkError, QueryError, MessageError):
                self.is_away, next_state_s = True, 0.0
            await self._notify()
            await asyncio.sleep(max(0.05, PERIOD_S - (time.monotonic() - began_s)))
            idle_s = 0.0 if self.watchers else idle_s + PERIOD_S
        self._task = None

    async def _look_for_server(self) -> None:
        """Say soon that there is no map server: the first question to it waits longer for one that starts again."""
        with contextlib.suppress(zenoh.ZError):  # the session was closed meanwhile
            is_there = await self.ask(is_answered, self.client.session, keys.map_query(self.name, "tiles"))
            self.is_away |= not is_there and self.answer is None
            await self._notify()

    async def _notify(self) -> None:
        async with self.moved:
            self.moved.notify_all()

    def _take(self, answer: TilesAnswer) -> None:
        if answer.whole:
            self.tiles.clear()
        self.tiles |= {(tile.x, tile.y): tile for tile in answer.tiles}
        self.answer = replace(answer, tiles=())

    async def _ask_state(self) -> dict[str, Any]:
        info = await self.info(0.0)
        machines, changes = await self.ask(self.client.machines), await self.ask(self.client.changes)
        self._rolls = {machine.name: [said] for machine in machines if (said := rolls(machine))}
        return {
            "name": self.name,
            "stamp_ns": info.stamp_ns,
            "first_ns": info.first_ns,
            "boundaries": list(info.boundaries),
            "trusted": {machine.name: machine.trusted for machine in machines},
            "changes": [plain(change) for change in changes],
        }

    def tracks(self) -> dict[str, list[Pose]]:
        """Where each machine was while somebody looked, oldest first: some MOST_POSES poses."""
        with self._poses_lock:
            return {name: list(track) for name, track in self._tracks.items()}

    @property
    def refused(self) -> Mapping[str, int]:
        """How many poses were not believed, by reason."""
        return dict(self._listener.refused) if self._listener else {}

    def _pose(self, key: str, data: bytes) -> Pose:
        return receive_pose(key, data, self._info[1].site.extent_m if self._info else MAX_EXTENT_M)

    def _on_health(self, health: Health) -> None:
        with self._poses_lock:
            if health.machine in self._poses:
                self._faults[health.machine] = faults_of(health.values)

    def _on_pose(self, pose: Pose) -> None:
        with self._poses_lock:
            self._poses[pose.machine] = pose, time.monotonic()
            track = self._tracks.setdefault(pose.machine, deque(maxlen=MOST_POSES))
            if not track or pose.stamp_ns >= track[-1].stamp_ns + TRACK_STEP_NS:
                track.append(pose)


def receive_health(key: str, data: bytes) -> Health:
    """The health report of the machine that its key names."""
    health = decode_health(data)
    if not key.endswith(f"/machine/{health.machine}/health"):
        raise MessageError(Refusal.WRONG_MACHINE, f"{health.machine!r} sends under {key}", field="machine")
    return health


def frame(answer: TilesAnswer) -> bytes:
    """Tiles for a page: length of a JSON head (4 bytes, big-endian), the head, the deflated planes end to end."""
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
    return b"".join([struct.pack(">I", len(text)), text, *(tile.planes for tile in answer.tiles)])


def _head(tile: MapTile) -> dict[str, Any]:
    numbers = {"x": tile.x, "y": tile.y, "row": tile.row, "fact": tile.fact, "newest_ns": tile.newest_ns}
    return {**numbers, "bytes": len(tile.planes)}


def _is_newer(tile: MapTile, version: MapVersion) -> bool:
    return tile.row > version.row or tile.fact > version.fact


def _site_of(info: MapInfo) -> SiteConfig:
    site = info.site
    return SiteConfig(site.name, site.origin_lat_deg, site.origin_lon_deg, site.origin_height_m, site.cell_m)


def names(feeds: Iterable[SiteFeed]) -> list[str]:
    """Names of sites."""
    return [feed.name for feed in feeds]
