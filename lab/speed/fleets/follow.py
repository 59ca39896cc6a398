"""Followers beside a map server: how soon they show what it has acknowledged, and what readers cost the machines.

Router, server, followers and readers are processes of their own, on this host, the machines send from here. Readers are
this module, `python -m lab.speed.fleets.follow ENDPOINT SECONDS [FOLLOWER...]`: it prints how often they were
answered, and how soon. Each asks one follower, as clients do, or the server where there is none.
"""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import zenoh

from lab.speed.fleets.fleet import Machine, samples, send
from lab.speed.measure import Report, machine
from lab.speed.merge_restart import SITE, build
from lab.speed.merge_work import BATCH, samples_of
from lab.speed.processes import ANSWER_S, OPTIONS, ask, process, processor_s, served, session, settle
from protocol.queries.answer_codec import decode_region
from protocol.queries.origin import decode_origin
from protocol.wire import keys
from protocol.wire.codec import decode_reply, encode_batch
from protocol.wire.messages import Ack, SampleBatch

READERS = 50
EVERY_S = 1.0  # a reader asks for a point and a region so often, as a page that shows the surroundings of a machine
LAYERS = ("resistance", "grade", "visits")
HALF_M = 32.0
PROBE_S, RETRY_S = 0.1, 0.5
QUIET = "[trust]\nexclude = false\n[calibration]\nautomatic = false\n"  # these machines drive past each other at random
FOLLOWERS = ("reader-1", "reader-2")
WHOLE = "bounds=-128,-128,128,128;layers=resistance,visits,age_s"
GOALS = {"visible_ms_p99": 500.0, "ingest_loss": 0.1, "equal": True}
VARIANTS = ("alone", "readers", "readers and followers")


def run(machines: int, seconds: float, hours: float, runs: int) -> Report:
    """Have machines send for so many seconds in each variant, paced, then as fast as they are served; variants in turn.

    Rows: for each variant medians over the runs: samples per second that were acknowledged, milliseconds until then,
    processor time of the server and of the followers, answers to readers; visible_ms: from an acknowledgement until a
    follower has answered with its row in the map. equal: the maps of server and followers, byte by byte, in the end.
    """
    with tempfile.TemporaryDirectory() as path, ExitStack() as opened:
        build(Path(path), samples_of(hours) // BATCH, tail_rows=0)
        endpoint, server = opened.enter_context(served(Path(path), SITE, OPTIONS + QUIET))
        links = [opened.enter_context(session(endpoint)) for _ in range(min(machines, 50))]
        fleet = [Machine(f"loader-{i:04d}", links[i % len(links)], samples(i)) for i in range(machines)]
        settle(server)
        measured: dict[str, list[dict[str, float]]] = {name: [] for name in VARIANTS}
        for number in range(runs):
            for name in VARIANTS[number % 3 :] + VARIANTS[: number % 3]:
                measured[name].append(_measured(name, endpoint, Path(path), server, fleet, seconds))
    rows: list[dict[str, Any]] = [{"variant": name, **_medians(each)} for name, each in measured.items()]
    losses = {
        f"{load}_loss": [round(1 - row[f"{load}_per_s"] / rows[0][f"{load}_per_s"], 3) for row in rows]
        for load in ("paced", "saturated")
    }
    return {
        "benchmark": "follow",
        "machines": machines,
        "readers": READERS,
        "seconds": seconds,
        "hours": hours,
        "runs": runs,
        **machine(),
        "goals": GOALS,
        "rows": [_complete(row | {name: each[i] for name, each in losses.items()}, rows) for i, row in enumerate(rows)],
    }


def _measured(
    name: str, endpoint: str, folder: Path, server: int, fleet: Sequence[Machine], seconds: float
) -> dict[str, float]:
    """One variant: paced, then saturated."""
    with ExitStack() as opened:
        followers = FOLLOWERS if name == VARIANTS[2] else ()
        pids = [opened.enter_context(_follower(endpoint, folder, one)) for one in followers]
        answers: list[dict[str, float]] = []
        if name != VARIANTS[0]:
            opened.enter_context(_readers(endpoint, 2 * seconds, followers, answers))
        with _probe(endpoint, bool(pids)) as probe:
            paced = _loaded([server, *pids], fleet, seconds, 1.0)
        saturated = _loaded([server, *pids], fleet, seconds, 0.0)
        out = {f"paced_{key}": value for key, value in paced.items()}
        out |= {f"saturated_{key}": value for key, value in saturated.items()}
        if pids:
            out["visible_ms_p50"], out["visible_ms_p99"] = (round(float(v), 1) for v in np.percentile(probe, (50, 99)))
            out["equal"] = _equal(endpoint)
    return out | (answers[0] if answers else {})


def _loaded(pids: Sequence[int], fleet: Sequence[Machine], seconds: float, period_s: float) -> dict[str, float]:
    cpu_s, start_s = [processor_s(pid) for pid in pids], time.monotonic()
    result = send(fleet, seconds, period_s)
    took_s = time.monotonic() - start_s
    cores = [(processor_s(pid) - before) / took_s for pid, before in zip(pids, cpu_s, strict=True)]
    p50, p99 = np.percentile(result.ms, (50, 99))
    figures = {"per_s": result.samples / took_s, "ack_ms_p50": p50, "ack_ms_p99": p99, "server_cores": cores[0]}
    return {key: round(float(value), 3) for key, value in {**figures, "follower_cores": sum(cores[1:])}.items()}


def _follower(endpoint: str, folder: Path, name: str) -> Any:
    files = ("--site-file", str(folder / "site.toml"), "--config", str(folder / "server.toml"), "--store", str(folder))
    return process("sitegrid.cli", "follow", "--endpoint", endpoint, "--name", name, *files)


@contextmanager
def _readers(endpoint: str, seconds: float, followers: Sequence[str], answers: list[dict[str, float]]) -> Any:
    """Readers of the map in a process of their own, until they have printed what they got."""
    words = [sys.executable, "-m", "lab.speed.fleets.follow", endpoint, str(seconds), *followers]
    root = Path(__file__).parent.parent.parent
    with subprocess.Popen(words, stdout=subprocess.PIPE, cwd=root, text=True) as child:  # noqa: S603
        try:
            if child.stdout is None or "ready" not in child.stdout.readline():
                raise RuntimeError("the readers did not start: nothing was measured")
            yield child.pid
            answers.append(json.loads(child.communicate(timeout=seconds + 60)[0]))
        finally:
            child.terminate()


@contextmanager
def _probe(endpoint: str, is_on: bool) -> Any:  # noqa: FBT001
    """Samples of one more machine, and how long after each acknowledgement a follower has it [ms]."""
    visible_ms: list[float] = []
    ending = threading.Event()

    def probe() -> None:
        legs, sent, name = samples(99_999), 0, f"probe-{time.time_ns() % 10**9}"
        with session(endpoint) as link:
            while not ending.is_set():
                rows = next(legs)
                batch = encode_batch(SampleBatch(name, 1, sent + 1, rows, SITE.frame))
                ack = decode_reply(ask(link, keys.ingest(SITE.name, name), batch)[0])
                if not isinstance(ack, Ack):
                    raise RuntimeError(f"the server refused a batch: {ack}")
                sent, began_s = ack.watermark, time.monotonic()
                follower = FOLLOWERS[len(visible_ms) % len(FOLLOWERS)]
                key = keys.follower_query(SITE.name, follower, "point")
                ask(link, f"{key}?x=1;y=1;layers=visits;after={ack.row};wait=10")
                visible_ms.append((time.monotonic() - began_s) * 1e3)
                ending.wait(PROBE_S)

    thread = threading.Thread(target=probe)
    if is_on:
        thread.start()
    try:
        yield visible_ms
    finally:
        ending.set()
        if is_on:
            thread.join()


def _equal(endpoint: str) -> bool:
    """Whether server and followers give the same bytes for one version of the map."""
    with session(endpoint) as link:
        (whole,) = ask(link, f"{keys.map_query(SITE.name, 'region')}?{WHOLE}")
        row = decode_region(whole).merged
        others = [keys.follower_query(SITE.name, name, "region") for name in FOLLOWERS]
        return all(ask(link, f"{key}?{WHOLE};after={row};wait=30") == [whole] for key in others)


def _complete(row: dict[str, Any], rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """A row with all columns that any has."""
    return {key: "-" for one in rows for key in one} | row


def _medians(each: Sequence[dict[str, float]]) -> dict[str, float]:
    return {key: statistics.median(one[key] for one in each) for key in each[0]}


def read(endpoint: str, seconds: float, followers: Sequence[str]) -> dict[str, Any]:
    """Have READERS ask for so long, each over a session of its own; how many answers, how soon [ms], from whom."""
    ms: list[float] = []
    origins: Counter[str] = Counter()
    with ExitStack() as opened:
        links = [opened.enter_context(session(endpoint)) for _ in range(READERS)]
        end_s = time.monotonic() + seconds

        def reader(number: int) -> None:
            draw = np.random.default_rng(number)
            time.sleep(EVERY_S * number / READERS)
            while (began_s := time.monotonic()) < end_s:
                x, y = draw.uniform(-200, 200, 2)
                box = f"{x - HALF_M:.3f},{y - HALF_M:.3f},{x + HALF_M:.3f},{y + HALF_M:.3f}"
                for query, where in (("point", f"x={x:.3f};y={y:.3f}"), ("region", f"bounds={box}")):
                    key = keys.map_query(SITE.name, query)
                    if followers:
                        key = keys.follower_query(SITE.name, followers[number % len(followers)], query)
                    origins[_answered(links[number], f"{key}?{where};layers={','.join(LAYERS)}")] += 1
                ms.append((time.monotonic() - began_s) * 1e3)
                time.sleep(max(0.0, EVERY_S - (time.monotonic() - began_s)))

        threads = [threading.Thread(target=reader, args=(number,)) for number in range(READERS)]
        print(json.dumps({"ready": READERS}), flush=True)
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    p50, p99 = np.percentile(ms, (50, 99))
    return {
        "answers_per_s": round(sum(origins.values()) / seconds, 1),
        "answer_ms_p50": round(float(p50), 1),
        "answer_ms_p99": round(float(p99), 1),
        "by_followers": round(1 - origins[""] / sum(origins.values()), 3),
    }


def _answered(link: zenoh.Session, selector: str) -> str:
    """Ask until there is an answer; the follower that gave it, empty for the server."""
    while True:
        for reply in link.get(selector, timeout=ANSWER_S):
            if reply.ok is not None and reply.ok.attachment is not None:
                return decode_origin(reply.ok.attachment.to_bytes()).follower
        time.sleep(RETRY_S)


if __name__ == "__main__":
    print(json.dumps(read(sys.argv[1], float(sys.argv[2]), sys.argv[3:])))
