"""A real site on loopback, measured from outside: router, map server, sessions, sending machines."""

from __future__ import annotations

import heapq
import os
import queue
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import zenoh

from protocol.arrays import Table
from protocol.config import toml_lines
from protocol.errors import Refusal
from protocol.queries.parameters import selector_of
from protocol.queries.request import MapQuery
from protocol.site.site_config import SiteConfig
from protocol.wire import keys
from protocol.wire.codec import decode_reply, encode_batch
from protocol.wire.messages import Ack, Refused, SampleBatch
from protocol.wire.session import SessionConfig, free_endpoint, open_session
from sitegrid.process.children import Children
from tests.memory import memory_mb
from tests.site_work import DAY_NS, drive

SITE = SiteConfig("bench", 48.0, 11.0)
OPTIONS = "[store]\narchive_after_h = 0.0\n"  # a load's samples are older than the journal's horizon
READY_S, ANSWER_S = 300.0, 120.0
SETTLED_CORES, SETTLE_S = 0.1, 300.0  # a fresh server searches changes everywhere
SAMPLES = 10  # per batch of a fleet
SESSIONS = 50  # shared by the machines
TIMEOUT_S = 10.0  # for an acknowledgement
RETRY_S = 0.2  # after a refusal without retry time


class Site(Children):
    """Router and map servers with a store in a folder, for the length of the block."""

    def __init__(self, folder: Path, site: SiteConfig = SITE, options: str = OPTIONS) -> None:
        super().__init__(folder)
        self.endpoint, self._folder = free_endpoint(), folder
        (folder / "site.toml").write_text("\n".join(toml_lines(asdict(site))))
        (folder / "server.toml").write_text(options)
        self.router = self.enter_context(self._running("router", "--listen", self.endpoint))

    def serving(self) -> AbstractContextManager[int]:
        """A map server, for the block; yields its process id."""
        return self._running("server", *self._files)

    def following(self, name: str) -> AbstractContextManager[int]:
        """A follower, for the block; yields its process id."""
        return self._running("follow", "--name", name, *self._files)

    @contextmanager
    def showing(self) -> Iterator[tuple[int, str]]:
        """A web server, for the block; yields its process id and address."""
        process = self.start("web", "web", "--endpoint", self.endpoint, "--site", SITE.name, "--listen", "127.0.0.1:0")
        try:
            yield process.pid, process.expect("ready", READY_S)["url"]
        finally:
            process.stop()

    @property
    def _files(self) -> tuple[str | Path, ...]:
        files = ("--site-file", self._folder / "site.toml", "--config", self._folder / "server.toml")
        return ("--endpoint", self.endpoint, "--store", self._folder, *files)

    @contextmanager
    def _running(self, *words: str | Path) -> Iterator[int]:
        process = self.start(str(words[0]), *words)
        try:
            process.expect("ready", READY_S)
            yield process.pid
        finally:
            process.stop()


@contextmanager
def session(endpoint: str) -> Iterator[zenoh.Session]:
    """A session with the router."""
    opened = open_session(SessionConfig(endpoint))
    try:
        yield opened
    finally:
        opened.close()  # type: ignore[no-untyped-call]


def ask(link: zenoh.Session, selector: str, payload: bytes | None = None) -> list[bytes]:
    """All replies to a query; RuntimeError if refused or none."""
    replies = list(link.get(selector, payload=payload, timeout=ANSWER_S))
    if not replies or any(reply.ok is None for reply in replies):
        problems = [reply.err.payload.to_bytes() for reply in replies if reply.err is not None]
        raise RuntimeError(f"{selector}: {problems or 'no answer'}")
    return [reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None]


def ask_map(link: zenoh.Session, query: MapQuery[Any]) -> list[bytes]:
    """All replies to a map query."""
    return ask(link, f"{keys.map_query(SITE.name, query.name)}?{selector_of(query.parameters())}")


def send(link: zenoh.Session, batch: SampleBatch, site: str = SITE.name) -> Ack:
    """Send a batch and wait for its acknowledgement."""
    (reply,) = ask(link, keys.ingest(site, batch.machine), encode_batch(batch))
    if not isinstance(answer := decode_reply(reply), Ack):
        raise RuntimeError(f"the server refused a batch: {answer}")
    return answer


@contextmanager
def meanwhile(work: Callable[[threading.Event], None]) -> Iterator[None]:
    """Run `work` on a thread during the block; its event is set at the end.

    RuntimeError if it failed.
    """
    ended, problems = threading.Event(), list[Exception]()

    def run() -> None:
        try:
            work(ended)
        except Exception as error:  # re-raised below
            problems.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
    if problems:
        raise RuntimeError("the machines stopped sending: nothing was measured") from problems[0]


def settle(server: int) -> None:
    """Wait until a process is idle."""
    end_s = time.monotonic() + SETTLE_S
    while time.monotonic() < end_s:
        with used(server) as cores:
            time.sleep(1.0)
        if cores[0] < SETTLED_CORES:
            return
    raise RuntimeError(f"the server was still busy after {SETTLE_S:g} s: nothing was measured")


@contextmanager
def used(*pids: int) -> Iterator[list[float]]:
    """Cores used by processes during the block, filled at its end."""
    cores: list[float] = []
    before, start_s = [processor_s(pid) for pid in pids], time.monotonic()
    yield cores
    took_s = time.monotonic() - start_s
    cores += [(processor_s(pid) - cpu_s) / took_s for pid, cpu_s in zip(pids, before, strict=True)]


def processor_s(pid: int) -> float:
    """CPU time of a process."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def forget_peak_mb(pid: int) -> float:
    """Reset a process's peak memory; returns the current."""
    Path(f"/proc/{pid}/clear_refs").write_text("5")
    return memory_mb(pid=pid)


# --- a fleet ---------------------------------------------------------------------------------------------------------


@dataclass
class Machine:
    """One machine: its next batch, and since when it waits for an acknowledgement."""

    name: str
    link: zenoh.Session
    samples: Iterator[Table]
    sent: int = 0  # acknowledged samples
    due_s: float = 0.0
    asked_s: float = 0.0
    payload: bytes = b""


@dataclass
class Sent:
    """Result of a run's batches. samples: acknowledged. ms: per batch. took_s: of all."""

    samples: int = 0
    refused: int = 0
    ms: list[float] = field(default_factory=list)
    took_s: float = 0.0

    @property
    def figures(self) -> dict[str, float]:
        """Samples per second, refused batches, milliseconds to acknowledgement."""
        p50, p99 = np.percentile(self.ms, (50, 99)).tolist()
        return {
            "samples_per_s": self.samples / self.took_s,
            "refused": self.refused,
            "ack_ms_p50": p50,
            "ack_ms_p99": p99,
        }


def fleet(links: Sequence[zenoh.Session], machines: int) -> list[Machine]:
    """Machines on shared sessions, a day after the store's."""
    return [Machine(f"loader-{i:04d}", links[i % len(links)], samples(i)) for i in range(machines)]


def samples(seed: int) -> Iterator[Table]:
    """Batches of one machine, a day after the store's."""
    for leg in drive(np.random.default_rng([1, seed])):
        leg["stamp_ns"] += DAY_NS
        for first in range(0, len(leg), SAMPLES):
            yield leg[first : first + SAMPLES]


def send_all(machines: Sequence[Machine], seconds: float, period_s: float) -> Sent:
    """Send a batch per machine every period_s, then wait for the last acknowledgements.

    One batch in flight per machine, like an agent. period_s: 0: the next upon acknowledgement.
    """
    answers: queue.SimpleQueue[tuple[int, float, Ack | Refused]] = queue.SimpleQueue()
    start_s, result, waiting = time.monotonic(), Sent(), 0
    for i, one in enumerate(machines):
        one.due_s = start_s + period_s * i / len(machines)
    due = [(one.due_s, i) for i, one in enumerate(machines)]
    heapq.heapify(due)
    while True:
        if time.monotonic() >= start_s + seconds:
            due.clear()
        while due and due[0][0] <= time.monotonic():
            _, i = heapq.heappop(due)
            _ask(machines[i], i, answers)
            waiting += 1
        if not (due or waiting):
            result.took_s = time.monotonic() - start_s
            return result
        try:
            wait_s = due[0][0] - time.monotonic() if due else TIMEOUT_S + 1
            i, at_s, answer = answers.get(timeout=max(0.0, wait_s))
        except queue.Empty:
            if due:
                continue
            raise RuntimeError(f"{waiting} batches were never answered") from None
        waiting -= 1
        _take(machines[i], answer, at_s, period_s, result)
        heapq.heappush(due, (machines[i].due_s, i))


def _ask(one: Machine, number: int, answers: queue.SimpleQueue[tuple[int, float, Ack | Refused]]) -> None:
    """Send the next or the refused batch; the reply carries the machine's index."""
    if not one.payload:
        one.payload = encode_batch(SampleBatch(one.name, 1, one.sent + 1, next(one.samples), SITE.frame))
    one.asked_s = time.monotonic()

    def answered(reply: zenoh.Reply) -> None:
        if reply.ok is not None:
            answers.put((number, time.monotonic(), decode_reply(reply.ok.payload.to_bytes())))

    handler = zenoh.handlers.Callback(answered, indirect=False)
    one.link.get(keys.ingest(SITE.name, one.name), handler, payload=one.payload, timeout=TIMEOUT_S)


def _take(one: Machine, answer: Ack | Refused, at_s: float, period_s: float, result: Sent) -> None:
    """Record a reply, and schedule the next batch."""
    if isinstance(answer, Ack):
        result.samples += answer.watermark - one.sent
        result.ms.append((at_s - one.asked_s) * 1e3)
        one.sent, one.payload = answer.watermark, b""
        one.due_s = max(one.due_s + period_s, at_s)
    elif answer.reason == Refusal.OVERLOADED:
        result.refused += 1
        one.due_s = at_s + (answer.retry_after_s or RETRY_S)
    else:
        raise RuntimeError(f"the server refused a batch: {answer}")
