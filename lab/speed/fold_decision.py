"""A machine of a real server is distrusted, and trusted again, while all machines send on and a client asks."""

from __future__ import annotations

import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

import numpy as np
import zenoh

from lab.speed.measure import memory_mb
from lab.speed.merge_restart import SITE, build
from lab.speed.merge_work import BATCH, Batches, batches, samples_of, seconds_of
from lab.speed.processes import ask, send, served, session
from protocol.arrays import Table
from protocol.queries.commands import MAX_WAIT_S, TrustCommand, encode_command
from protocol.queries.parameters import selector_of
from protocol.queries.requests import PointQuery, encode_query
from protocol.wire import keys
from protocol.wire.messages import SampleBatch

LAYERS = ("resistance", "grade", "confidence")
ASK_S, SEND_S = 0.02, 0.2  # between two questions; between two seconds of the machines, which work five times as fast
QUIET_S = 3.0  # without a decision, to compare with; as long again before, when a server that has just come is busy
CLEAR_PEAK = "5"  # written to clear_refs: the most memory there ever was counts from here


@dataclass
class Traffic:
    """What a client and machines waited for: when each question or batch was sent [s], and how long it took [ms]."""

    points: list[tuple[float, float]] = field(default_factory=list)
    batches: list[tuple[float, float]] = field(default_factory=list)


def decisions(hours: float) -> Iterator[dict[str, str | float | None]]:
    """After so many hours of ten machines, decide about one.

    Rows: what is done (nothing, at first), seconds until the map follows, milliseconds until a point at a random place
    was answered and a batch acknowledged meanwhile, and memory of the server: before, and the most.
    """
    work = batches()
    before = list(islice(work, samples_of(hours) // BATCH))
    driven = np.concatenate([rows for _, rows in before])
    name = before[0][0]
    steps: dict[str, Callable[[zenoh.Session], None]] = {
        "nothing": lambda _: time.sleep(QUIET_S),
        "distrust": lambda link: _decide(link, TrustCommand(name, False, "benchmark", MAX_WAIT_S)),
        "trust": lambda link: _decide(link, TrustCommand(name, True, "", MAX_WAIT_S)),
    }
    with tempfile.TemporaryDirectory() as path:
        build(Path(path), len(before), tail_rows=0)
        with (
            served(Path(path), SITE) as (endpoint, pid),
            session(endpoint) as link,
            _traffic(endpoint, driven, seconds_of(work)) as traffic,
        ):
            time.sleep(QUIET_S)
            for what, step in steps.items():
                yield _measured(what, pid, traffic, lambda: step(link))  # noqa: B023 # called at once


def _measured(what: str, pid: int, traffic: Traffic, step: Callable[[], None]) -> dict[str, str | float | None]:
    Path(f"/proc/{pid}/clear_refs").write_text(CLEAR_PEAK)
    server_mb = memory_mb(pid=pid)
    began_s = time.monotonic()
    step()
    ended_s = time.monotonic()
    time.sleep(2 * SEND_S)  # for what was sent in the end
    row: dict[str, str | float | None] = {"decision": what, "wall_s": round(ended_s - began_s, 2)}
    for name, sent in (("point", traffic.points), ("ack", traffic.batches)):
        took_ms = [ms for sent_s, ms in sent if began_s <= sent_s < ended_s]
        for figure, percent in (("median", 50), ("p99", 99), ("most", 100)):
            row[f"{name}_ms_{figure}"] = round(float(np.percentile(took_ms, percent)), 1) if took_ms else None
    return row | {"server_mb": round(server_mb, 1), "peak_mb": round(memory_mb("VmHWM", pid), 1)}


def _decide(link: zenoh.Session, command: TrustCommand) -> None:
    ask(link, f"{keys.admin(SITE.name, command.name)}?{selector_of(encode_command(command))}")


@contextmanager
def _traffic(endpoint: str, driven: Table, seconds: Iterator[Batches]) -> Iterator[Traffic]:
    """A client and machines, each on a thread and in a session of its own."""
    traffic, ended, problems = Traffic(), threading.Event(), list[Exception]()

    def repeat(each_s: float, work: Callable[[zenoh.Session], None]) -> None:
        try:
            with session(endpoint) as link:
                while not ended.wait(each_s):
                    work(link)
        except Exception as error:  # handed on below
            problems.append(error)

    draw, sent = np.random.default_rng(0), Counter[str]()

    def ask_point(link: zenoh.Session) -> None:
        x, y = (float(driven[name][k]) for k in [draw.integers(len(driven))] for name in ("x_m", "y_m"))
        query = PointQuery(x, y, LAYERS)
        selector = f"{keys.map_query(SITE.name, query.name)}?{selector_of(encode_query(query))}"
        traffic.points.append(_timed(lambda: ask(link, selector)))

    def send_second(link: zenoh.Session) -> None:
        for name, rows in next(seconds):
            batch = SampleBatch(name, 2, sent[name] + 1, rows, SITE.frame)
            traffic.batches.append(_timed(lambda: send(link, SITE, batch)))  # noqa: B023 # called at once
            sent[name] += len(rows)

    threads = [threading.Thread(target=repeat, args=each) for each in ((ASK_S, ask_point), (SEND_S, send_second))]
    for thread in threads:
        thread.start()
    try:
        yield traffic
    finally:
        ended.set()
        for thread in threads:
            thread.join()
    if problems:
        raise RuntimeError("client or machines stopped") from problems[0]


def _timed(work: Callable[[], object]) -> tuple[float, float]:
    sent_s = time.monotonic()
    work()
    return sent_s, (time.monotonic() - sent_s) * 1e3
