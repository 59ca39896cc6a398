"""A whole fleet at one map server: how fast batches are acknowledged, what that costs it, and how many it takes.

Router and server are processes of their own, the machines send from here: each one batch at a time, as an agent does,
and the next when it is due, or at once to see how many batches the server takes.
"""

from __future__ import annotations

import heapq
import queue
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import zenoh

from lab.speed.measure import Report, machine, memory_mb
from lab.speed.merge_restart import SITE, build
from lab.speed.merge_work import BATCH, DAY_NS, drive, samples_of
from lab.speed.processes import processor_s, routed, serving, session, settle
from protocol.arrays import Table
from protocol.errors import Refusal
from protocol.wire import keys
from protocol.wire.codec import decode_reply, encode_batch
from protocol.wire.messages import Ack, Refused, SampleBatch

SAMPLES = 10  # in a batch
PERIOD_S = 1.0  # from batch to batch of one machine
SESSIONS = 50  # at most: machines share them
TIMEOUT_S = 10.0  # for an acknowledgement
RETRY_S = 0.2  # after a refusal that does not say when to come again
GOALS = {"refused": 0, "ack_ms_p99": 150.0, "server_cores": 0.6, "disk_mb_per_s": 7.0, "saturation_per_s": 25_000}


@dataclass
class Machine:
    """One machine: what it sends next, and since when it waits for an acknowledgement."""

    name: str
    link: zenoh.Session
    samples: Iterator[Table]
    sent: int = 0  # samples that were acknowledged
    due_s: float = 0.0
    asked_s: float = 0.0
    payload: bytes = b""


@dataclass
class Acknowledgements:
    """What came of the batches of one run. samples: acknowledged; ms: of each batch."""

    samples: int = 0
    refused: int = 0
    ms: list[float] = field(default_factory=list)


def run(machines: int, seconds: float, hours: float) -> Report:
    """Have so many machines send for so many seconds to a server with a store of so many hours of work.

    Rows: load (paced: a batch per machine and second; saturated: the next as soon as one is acknowledged), samples per
    second that were acknowledged, batches that were refused, milliseconds until a batch is acknowledged, processor
    time of server and router, the most memory that each had so far, and what the server has written to disk.
    """
    with tempfile.TemporaryDirectory() as path, ExitStack() as opened:
        build(Path(path), samples_of(hours) // BATCH, tail_rows=0)
        endpoint, router = opened.enter_context(routed())
        server = opened.enter_context(serving(endpoint, Path(path), SITE))
        links = [opened.enter_context(session(endpoint)) for _ in range(min(machines, SESSIONS))]
        fleet = [Machine(f"loader-{i:04d}", links[i % len(links)], samples(i)) for i in range(machines)]
        settle(server)
        rows = [
            {"load": name, "machines": machines, **_measured(server, router, fleet, seconds, period_s)}
            for name, period_s in (("paced", PERIOD_S), ("saturated", 0.0))
        ]
    return {"benchmark": "fleet", "hours": hours, "seconds": seconds, **machine(), "goals": GOALS, "rows": rows}


def samples(seed: int) -> Iterator[Table]:
    """Batches of one machine, on the day after that of the store."""
    for leg in drive(np.random.default_rng([1, seed])):
        leg["stamp_ns"] += DAY_NS
        for first in range(0, len(leg), SAMPLES):
            yield leg[first : first + SAMPLES]


def _measured(server: int, router: int, fleet: Sequence[Machine], seconds: float, period_s: float) -> dict[str, float]:
    before = [processor_s(pid) for pid in (server, router)]
    written, start_s = _written_bytes(server), time.monotonic()
    result = send(fleet, seconds, period_s)
    took_s = time.monotonic() - start_s
    cores = [(processor_s(pid) - cpu_s) / took_s for pid, cpu_s in zip((server, router), before, strict=True)]
    return {
        "samples_per_s": round(result.samples / took_s, 1),
        "refused": result.refused,
        "ack_ms_p50": round(float(np.percentile(result.ms, 50)), 1),
        "ack_ms_p99": round(float(np.percentile(result.ms, 99)), 1),
        "server_cores": round(cores[0], 3),
        "router_cores": round(cores[1], 3),
        "server_mb": round(memory_mb("VmHWM", server)),
        "router_mb": round(memory_mb("VmHWM", router)),
        "disk_mb_per_s": round((_written_bytes(server) - written) / took_s / 1e6, 2),
    }


def send(fleet: Sequence[Machine], seconds: float, period_s: float) -> Acknowledgements:
    """Send for so many seconds, and wait for the last acknowledgements."""
    answers: queue.SimpleQueue[tuple[int, float, Ack | Refused]] = queue.SimpleQueue()
    start_s = time.monotonic()
    result = Acknowledgements()
    for i, each in enumerate(fleet):
        each.due_s = start_s + period_s * i / len(fleet)
    due = [(each.due_s, i) for i, each in enumerate(fleet)]
    heapq.heapify(due)
    waiting = 0
    while True:
        now_s = time.monotonic()
        if now_s >= start_s + seconds:
            due.clear()
        while due and due[0][0] <= now_s:
            _, i = heapq.heappop(due)
            _ask(fleet[i], i, answers)
            waiting += 1
        if not (due or waiting):
            return result
        try:
            wait_s = due[0][0] - time.monotonic() if due else TIMEOUT_S + 1
            i, at_s, answer = answers.get(timeout=max(0.0, wait_s))
        except queue.Empty:
            if due:
                continue
            raise RuntimeError(f"{waiting} batches were never answered") from None
        waiting -= 1
        _take(fleet[i], answer, at_s, period_s, result)
        heapq.heappush(due, (fleet[i].due_s, i))


def _ask(one: Machine, number: int, answers: queue.SimpleQueue[tuple[int, float, Ack | Refused]]) -> None:
    """Send the next batch, or the refused one again; its answer comes with the number of its machine."""
    if not one.payload:
        one.payload = encode_batch(SampleBatch(one.name, 1, one.sent + 1, next(one.samples), SITE.frame))
    one.asked_s = time.monotonic()

    def answered(reply: zenoh.Reply) -> None:
        if reply.ok is not None:
            answers.put((number, time.monotonic(), decode_reply(reply.ok.payload.to_bytes())))

    handler = zenoh.handlers.Callback(answered, indirect=False)
    one.link.get(keys.ingest(SITE.name, one.name), handler, payload=one.payload, timeout=TIMEOUT_S)


def _take(one: Machine, answer: Ack | Refused, at_s: float, period_s: float, result: Acknowledgements) -> None:
    """Note an answer, and when the machine sends again."""
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


def _written_bytes(process: int) -> int:
    """What a process has had written to disks."""
    lines = Path(f"/proc/{process}/io").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("write_bytes"))
