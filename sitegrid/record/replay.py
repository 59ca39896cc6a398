"""Replay recordings: readings to agents in their original bundles, or samples to a map server."""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import replace
from typing import Any

import zenoh

from agents.drivers.replay import SPAN_NS
from protocol.errors import LinkError, MessageError, QueryError, Refusal
from protocol.machine.readings import Reading
from protocol.machine.recorded_readings import RecordedReading
from protocol.recording import MSGPACK, Message
from protocol.site.site_config import MAX_EXTENT_M
from protocol.wire import keys
from protocol.wire.bundle_stream import BundleStream, StreamClock
from protocol.wire.codec import decode_batch, decode_health, decode_reply, encode_batch
from protocol.wire.messages import Ack, Refused
from sitegrid.health import number_of

MOST_READINGS = 1000  # per bundle: 100 kB
MOST_AHEAD = 2000  # bundles not yet taken by an agent; half of its queue
SILENT_S = 30.0  # timeout: no agent, or none that takes readings
REPLY_S = 3.0  # timeout of a map server's reply
POLL_S = 0.05
Sign = Callable[[str, bytes], bytes]
Bundle = tuple[str, int, list[Reading]]  # machine, time of recording, readings


class _Open:
    """A bundle being filled; its readings leave an agent's sort in the order they entered."""

    def __init__(self, log_ns: int) -> None:
        self.log_ns, self.readings = log_ns, list[Reading]()
        self._sensors: dict[tuple[str, str], int] = {}
        self._last = (0, 0)

    def takes(self, reading: Reading, log_ns: int) -> bool:
        """Add a reading if it fits: agents sort by stamp, then sensor, stably."""
        place = reading.stamp_ns, self._sensors.get((reading.sensor, reading.kind), len(self._sensors))
        is_long = log_ns - self.log_ns >= SPAN_NS or len(self.readings) == MOST_READINGS
        if self.readings and (is_long or place < self._last):
            return False
        self._last = place
        self._sensors.setdefault((reading.sensor, reading.kind), len(self._sensors))
        self.readings.append(reading)
        return True


def bundles(recorded: Iterable[RecordedReading]) -> Iterator[Bundle]:
    """Readings in bundles, in each agent's original order."""
    opened: dict[str, _Open] = {}
    for machine, log_ns, reading in recorded:
        if not opened.setdefault(machine, _Open(log_ns)).takes(reading, log_ns):
            full, opened[machine] = opened[machine], _Open(log_ns)
            yield machine, full.log_ns, full.readings
            opened[machine].takes(reading, log_ns)
    for machine, rest in opened.items():
        yield machine, rest.log_ns, rest.readings


class Agents:
    """Feeds a site's agents no faster than their health shows progress. sent: by machine."""

    def __init__(self, session: zenoh.Session, endpoint: str, site: str, stop: threading.Event) -> None:
        self._session, self._endpoint, self._site, self._stop = session, endpoint, site, stop
        self._taken: dict[str, int] = {}  # readings taken by each agent since its start, from any source
        self._streams: dict[str, BundleStream] = {}
        self._ahead: dict[str, deque[int]] = {}  # per bundle under way: the agent's count once it is taken
        self._health: Any = session.declare_subscriber(keys.health_all(site), self._on_health)
        self.sent: Counter[str] = Counter()

    def feed(self, machine: str, readings: list[Reading]) -> None:
        """Publish a bundle once its agent is present and close behind; LinkError on timeout."""
        if machine not in self._streams:
            self._wait(lambda: machine in self._taken, f"no agent of {machine} runs on site {self._site}: start one")
            self._ahead[machine] = deque([self._taken.get(machine, 0)])
            self._streams[machine] = BundleStream(self._session, self._site, machine)
        ahead = self._ahead[machine]
        self._wait(lambda: self._is_near(machine), f"the agent of {machine} takes no readings: look at its health")
        self._streams[machine].put(tuple(readings))
        self.sent[machine] += len(readings)
        ahead.append(ahead[-1] + len(readings))

    def close(self) -> None:
        """End the streams, and thereby the agents."""
        self._health.undeclare()
        for stream in self._streams.values():
            stream.close()

    def _is_near(self, machine: str) -> bool:
        ahead = self._ahead[machine]
        while len(ahead) > 1 and ahead[0] <= self._taken[machine]:
            ahead.popleft()
        return len(ahead) < MOST_AHEAD

    def _wait(self, is_so: Callable[[], bool], problem: str) -> None:
        end_s = time.monotonic() + SILENT_S
        while not is_so() and not self._stop.wait(POLL_S):
            if time.monotonic() > end_s:
                raise LinkError(self._endpoint, problem)

    def _on_health(self, sample: zenoh.Sample) -> None:
        with suppress(MessageError):
            health = decode_health(sample.payload.to_bytes())
            self._taken[health.machine] = int(number_of(health.values, "readings") or 0)


def feed_agents(recorded: Iterable[RecordedReading], agents: Agents, speed: float, stop: threading.Event) -> None:
    """Feed agents at a multiple of recorded speed; 0: as fast as they take."""
    begin_ns, pace = 0, StreamClock(speed, stop, time.monotonic)
    for machine, log_ns, readings in bundles(recorded):
        begin_ns = begin_ns or log_ns
        pace.wait((log_ns - begin_ns) * 1e-9)
        if stop.is_set():
            return
        agents.feed(machine, readings)


class SampleSender:
    """Sends sample batches to a map server as the machines did. sent, had: new samples, and duplicates."""

    def __init__(self, session: zenoh.Session, endpoint: str, site: str, sign: Sign | None) -> None:
        """sign: signature of a batch, on a site with keys."""
        self._session, self._endpoint, self._site, self._sign = session, endpoint, site, sign
        self.sent = self.had = 0

    def send(self, machine: str, data: bytes, stop: threading.Event) -> None:
        """Send a batch until acknowledged; QueryError if refused, LinkError without an answer."""
        batch = decode_batch(data, MAX_EXTENT_M)
        end_s = time.monotonic() + SILENT_S
        while not stop.is_set():
            match self._ask(keys.ingest(self._site, machine), data):
                case Ack(trimmed=trimmed):
                    self.sent, self.had = self.sent + len(batch.rows) - trimmed, self.had + trimmed
                    return
                case Refused(reason=Refusal.GAP, expected=expected) if 0 < expected < batch.first_seq:
                    data = encode_batch(replace(batch, lost_before=batch.first_seq - expected))  # not recorded
                case Refused(retry_after_s=wait_s) if wait_s and time.monotonic() < end_s:
                    stop.wait(wait_s)
                case Refused(reason, problem):
                    raise QueryError(reason, f"samples of {machine}: {problem}")
                case None if time.monotonic() >= end_s:
                    raise LinkError(self._endpoint, f"no map server of site {self._site} takes samples of {machine}")

    def _ask(self, key: str, data: bytes) -> Ack | Refused | None:
        signature = self._sign(key, data) if self._sign else None
        for reply in self._session.get(key, payload=data, attachment=signature, timeout=REPLY_S):
            if reply.ok is not None:
                return decode_reply(reply.ok.payload.to_bytes())
        time.sleep(POLL_S)  # without a server the reply is instant
        return None


def send_samples(messages: Iterable[Message], sender: SampleSender, speed: float, stop: threading.Event) -> None:
    """Send a recording's samples; speed as in `feed_agents`."""
    begin_ns, pace = 0, StreamClock(speed, stop, time.monotonic)
    for message in messages:
        words = message.topic.split("/")
        if message.schema != MSGPACK or len(words) != 4 or words[3] != "samples":
            continue
        begin_ns = begin_ns or message.log_ns
        pace.wait((message.log_ns - begin_ns) * 1e-9)
        if stop.is_set():
            return
        sender.send(words[2], message.data, stop)
