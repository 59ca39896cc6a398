"""Record a running site's messages, machines and map server, into one file.

Zenoh's callbacks only fill a bounded queue, so the site never waits, except for one tile query at a time. Overflow is
dropped and counted.
"""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from typing import TYPE_CHECKING, Any

import zenoh

from protocol.errors import LinkError, MessageError, QueryError, StoreError
from protocol.machine.recorded_readings import record_reading
from protocol.queries.answers import GroundChange, MapVersion
from protocol.queries.map_tiles import AREA, TilesQuery
from protocol.recording import MSGPACK, Message, Recording
from protocol.wire import keys
from protocol.wire.codec import decode_bundle, decode_health, receive_pose
from protocol.wire.latest_values import MOST_NAMES
from sitegrid.client import Client
from sitegrid.features.feature import projection_of
from sitegrid.record.messages import (
    LAYERS,
    SiteMessage,
    change_of,
    gap_of,
    health_of,
    kind_of,
    place_of,
    tile_of,
    transform_of,
)

if TYPE_CHECKING:
    from sitegrid.record.samples import NewSamples

LOOK_S = 5.0  # between tile queries, answered with changes
SECOND_S = 1.0
MOST_BYTES = 64 * 2**20  # queue capacity: minutes of a large site
TILE_BYTES = 8 * AREA * len(LAYERS)  # of a tile as a message
WHAT = ("poses", "health", "readings", "tiles", "changes")
log = logging.getLogger("sitegrid.record")
Work = Callable[[], None]


class Waiting:
    """Queue of work, bounded in bytes."""

    def __init__(self, most_bytes: int = MOST_BYTES) -> None:
        self._queue: queue.SimpleQueue[tuple[Work, int]] = queue.SimpleQueue()
        self._left_bytes, self._room = most_bytes, threading.Condition()

    def put(self, work: Work, size: int, wait_s: float = 0.0) -> bool:
        """Enqueue work; False if there is no room in time."""
        with self._room:
            if not self._room.wait_for(lambda: self._left_bytes >= size, wait_s):
                return False
            self._left_bytes -= size
        self._queue.put((work, size))
        return True

    def do_next(self, wait_s: float) -> None:
        """Do the oldest work, if any arrives in time."""
        try:
            work, size = self._queue.get(timeout=wait_s)
        except queue.Empty:
            return
        with self._room:
            self._left_bytes += size
            self._room.notify_all()
        work()


class SiteRecorder:
    """Records one site until stopped. tell: called with a line per gap. lost: dropped or refused messages."""

    def __init__(
        self,
        client: Client,
        recording: Recording,
        what: tuple[str, ...],
        samples: NewSamples | None = None,
        tell: Callable[[str], None] = log.warning,
    ) -> None:
        self._client, self._recording, self._what, self._samples = client, recording, what, samples
        self._projection = projection_of(client.site_info())
        self._tell, self._waiting, self._stop = tell, Waiting(), threading.Event()
        self._gaps: dict[str, float] = {}  # what is missing, since when
        self._listened: dict[str, Any] = {}
        self.lost: Counter[str] = Counter()

    def run(self, is_stopped: Callable[[], bool]) -> None:
        """Record until `is_stopped`; OSError if the disk is full."""
        with ExitStack() as opened:
            session, site = self._client.session, self._client.site
            if "poses" in self._what:
                opened.callback(self._subscribe(keys.poses_all(site), self._on_pose))
            if "health" in self._what:
                opened.callback(self._subscribe(keys.health_all(site), self._on_health))
            if "readings" in self._what:
                heard = partial(self._on_sample, self._on_token)
                tokens: Any = session.liveliness().declare_subscriber(keys.alive_all(site), heard, history=True)
                opened.callback(tokens.undeclare)
                opened.callback(lambda: [stop() for stop in self._listened.values()])
            if {"tiles", "changes"} & set(self._what):
                looking = threading.Thread(target=self._look, name="tiles")
                looking.start()
                opened.callback(looking.join)
            opened.callback(self._stop.set)
            due_s = time.monotonic()
            while not is_stopped():
                self._waiting.do_next(SECOND_S / 5)
                if time.monotonic() >= due_s:
                    due_s = time.monotonic() + SECOND_S
                    self._tend()
            self._tend()  # late samples

    def counts(self) -> dict[str, int]:
        """Messages by kind."""
        counts: Counter[str] = Counter()
        for topic, count in self._recording.counts.items():
            counts[kind_of(topic)] += count
        return dict(counts)

    def _tend(self) -> None:
        self._note_gap("router", "" if self._client.session.info.routers_zid() else "no router")
        if self._samples:
            problem = ""
            try:
                for name, batch in self._samples.read():
                    topic, now_ns = f"/machine/{name}/samples", time.time_ns()
                    self._recording.write(Message(topic, MSGPACK, now_ns, now_ns, batch), {})
            except StoreError as error:
                problem = str(error)
            self._note_gap("store", problem)
        self._recording.tend()

    def _subscribe(self, key: str, take: Callable[[str, bytes, int], None]) -> Callable[[], None]:
        subscriber: Any = self._client.session.declare_subscriber(key, partial(self._on_sample, take))
        undeclare: Callable[[], None] = subscriber.undeclare
        return undeclare

    def _on_sample(self, take: Callable[[str, bytes, int], None], sample: zenoh.Sample) -> None:
        data = sample.payload.to_bytes()
        work = partial(self._take, take, str(sample.key_expr), data, time.time_ns())
        if not self._waiting.put(work, len(data) + 1000):  # plus Python's overhead
            self.lost["dropped"] += 1

    def _take(self, take: Callable[[str, bytes, int], None], key: str, data: bytes, log_ns: int) -> None:
        try:
            take(key, data, log_ns)
        except (MessageError, ValueError):  # ValueError: numbers unknown to JSON
            self.lost["refused"] += 1

    def _on_pose(self, key: str, data: bytes, log_ns: int) -> None:
        pose = receive_pose(key, data)
        transform_of(pose).record(self._recording, log_ns)
        place_of(pose, self._projection).record(self._recording, log_ns)

    def _on_health(self, key: str, data: bytes, log_ns: int) -> None:
        health = decode_health(data)
        if health.machine == keys.machine_of(key):
            health_of(health).record(self._recording, log_ns)

    def _on_token(self, key: str, *_: object) -> None:
        """Subscribe to a machine's readings after its agent, because the simulator waits for the agent."""
        name = keys.machine_of(key)
        if name not in self._listened and len(self._listened) < MOST_NAMES:
            self._listened[name] = self._subscribe(keys.sensors(self._client.site, name), self._on_bundle)

    def _on_bundle(self, key: str, data: bytes, log_ns: int) -> None:
        bundle = decode_bundle(data)
        if bundle.machine == keys.machine_of(key):
            for reading in bundle.readings:
                record_reading(self._recording, bundle.machine, log_ns, reading)

    def _look(self) -> None:
        """Query map changes repeatedly; after a gap its changes follow."""
        version: MapVersion | None = None
        known: dict[int, GroundChange] = {}
        while not self._stop.is_set():
            problem = ""
            try:
                answer = self._client.ask(TilesQuery(version))
                if "tiles" in self._what:
                    for tile in answer.tiles:
                        self._enqueue(partial(tile_of, tile, answer.cell_m), TILE_BYTES)
                if "changes" in self._what and answer.version != version:
                    for change in self._client.changes():
                        if known.get(change.id) != change:
                            known[change.id] = change
                            self._enqueue(partial(change_of, change), 1000)
                version = answer.version
            except (LinkError, MessageError, QueryError) as error:
                problem = str(error)
            self._waiting.put(partial(self._note_gap, "map", problem), 0)
            self._stop.wait(LOOK_S)

    def _enqueue(self, message: Callable[[], SiteMessage], size: int) -> None:
        """Enqueue a message as soon as there is room."""
        work = partial(self._record, message, time.time_ns())
        while not self._stop.is_set() and not self._waiting.put(work, size, SECOND_S):
            pass

    def _record(self, message: Callable[[], SiteMessage], log_ns: int) -> None:
        message().record(self._recording, log_ns)

    def _note_gap(self, what: str, problem: str) -> None:
        """Report and record the start or end of a gap."""
        if bool(problem) == (what in self._gaps):
            return
        if problem:
            self._gaps[what] = time.monotonic()
            self.lost["gaps"] += 1
            line = f"gap: {problem}"
        else:
            line = f"the gap without {what} ends after {time.monotonic() - self._gaps.pop(what):.0f} s"
        self._tell(line)
        gap_of(time.time_ns(), line).record(self._recording, time.time_ns())
