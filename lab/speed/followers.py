"""Followers beside a map server: their lag, and the readers' cost to machines.

Router, server, followers and readers are local processes; machines send from here. Readers: `python -m
lab.speed.followers ENDPOINT SECONDS [FOLLOWER...]`; each queries one follower, like clients, or else the server.
"""

from __future__ import annotations

import json
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import numpy as np
import zenoh

from lab.speed.measure import Figures, child, in_turn, rows_of
from lab.speed.site import (
    ANSWER_S,
    SESSIONS,
    SITE,
    Machine,
    Site,
    ask,
    fleet,
    meanwhile,
    samples,
    send,
    send_all,
    session,
    settle,
    used,
)
from lab.speed.site import OPTIONS as STORE_OPTIONS
from protocol.queries.answer_codec import decode_region
from protocol.queries.origin import decode_origin
from protocol.wire import keys
from protocol.wire.messages import SampleBatch
from sitegrid.proof.figures import Row
from tests.site_work import BATCH, samples_of, write_store

OPTIONS = {"machines": 100, "seconds": 15.0, "hours": 1.0, "runs": 3}
ALONE, READ, FOLLOWED = "alone", "readers", "readers and followers"
GOALS = {
    (FOLLOWED, "visible_ms_p99"): "<= 500",
    (FOLLOWED, "paced_loss"): "<= 0.1",
    (FOLLOWED, "saturated_loss"): "<= 0.1",
    (FOLLOWED, "equal"): ">= 1",
}
READERS = 50
EVERY_S = 1.0  # reader interval for a point and a region, like a page around a machine
LAYERS = ("resistance", "grade", "visits")
HALF_M = 32.0
PROBE_S, RETRY_S, END_S = 0.1, 0.5, 60.0
QUIET = "[trust]\nexclude = false\n[calibration]\nautomatic = false\n"  # these machines' tracks cross at random
FOLLOWERS = ("reader-1", "reader-2")
WHOLE = "bounds=-128,-128,128,128;layers=resistance,visits,age_s"
LOADS = {"paced": 1.0, "saturated": 0.0}  # seconds between batches of a machine


def run(machines: int, seconds: float, hours: float, runs: int) -> Iterator[Row]:
    """Machines send paced, then saturated; variants in turn.

    paced_, saturated_: acknowledged samples per second, milliseconds to acknowledgement, cores of server and followers,
    throughput lost against `alone`. visible_ms: from acknowledgement until a follower answers with that row. equal: 1
    if server and followers finally answer with equal bytes.
    """
    with tempfile.TemporaryDirectory() as path, ExitStack() as opened:
        site = opened.enter_context(Site(Path(path), options=STORE_OPTIONS + QUIET))
        write_store(Path(path), SITE, samples_of(hours) // BATCH, tail_rows=0)
        server = opened.enter_context(site.serving())
        links = [opened.enter_context(session(site.endpoint)) for _ in range(min(machines, SESSIONS))]
        senders = fleet(links, machines)
        settle(server)
        variants = {name: partial(_measured, name, site, server, senders, seconds) for name in (ALONE, READ, FOLLOWED)}
        took = in_turn(variants, runs)
    for name, figures in took.items():
        loss = {f"{load}_loss": 1 - figures[each] / took[ALONE][each] for load in LOADS for each in [f"{load}_per_s"]}
        yield from rows_of(name, figures | loss)


def _measured(name: str, site: Site, server: int, senders: Sequence[Machine], seconds: float) -> Figures:
    """One variant: paced, then saturated."""
    followers, out = FOLLOWERS if name == FOLLOWED else (), dict[str, float | None]()
    with ExitStack() as opened:
        pids = [opened.enter_context(site.following(each)) for each in followers]
        visible_ms, printed = list[float](), list[Figures]()
        if name != ALONE:
            words = (site.endpoint, str(2 * seconds), *followers)
            reading = child("lab.speed.followers", *words, end_s=2 * seconds + END_S)
            printed = opened.enter_context(reading)
        for load, period_s in LOADS.items():
            with ExitStack() as probed:
                if pids and load == "paced":
                    probed.enter_context(meanwhile(partial(_probe, site.endpoint, visible_ms)))
                out |= _loaded(load, [server, *pids], senders, seconds, period_s)
        if pids:
            p50, p99 = np.percentile(visible_ms, (50, 99)).tolist()
            out |= {"visible_ms_p50": p50, "visible_ms_p99": p99, "equal": float(_equal(site.endpoint))}
    return {**out, **(printed[0] if printed else {})}


def _loaded(
    load: str, pids: Sequence[int], senders: Sequence[Machine], seconds: float, period_s: float
) -> dict[str, float]:
    with used(*pids) as cores:
        sent = send_all(senders, seconds, period_s).figures
    figures = {"per_s": sent["samples_per_s"], "ack_ms_p50": sent["ack_ms_p50"], "ack_ms_p99": sent["ack_ms_p99"]}
    figures |= {"server_cores": cores[0], "follower_cores": sum(cores[1:])}
    return {f"{load}_{name}": value for name, value in figures.items()}


def _probe(endpoint: str, visible_ms: list[float], ended: threading.Event) -> None:
    """Probe machine: time from acknowledgement to visibility at a follower [ms]."""
    legs, sent, name = samples(99_999), 0, f"probe-{time.time_ns() % 10**9}"
    with session(endpoint) as link:
        while not ended.is_set():
            ack = send(link, SampleBatch(name, 1, sent + 1, next(legs), SITE.frame))
            sent, began_s = ack.watermark, time.monotonic()
            follower = FOLLOWERS[len(visible_ms) % len(FOLLOWERS)]
            key = keys.follower_query(SITE.name, follower, "point")
            ask(link, f"{key}?x=1;y=1;layers=visits;after={ack.row};wait=10")
            visible_ms.append((time.monotonic() - began_s) * 1e3)
            ended.wait(PROBE_S)


def _equal(endpoint: str) -> bool:
    """Whether server and followers answer one map version with equal bytes."""
    with session(endpoint) as link:
        (whole,) = ask(link, f"{keys.map_query(SITE.name, 'region')}?{WHOLE}")
        row = decode_region(whole).merged
        others = [keys.follower_query(SITE.name, name, "region") for name in FOLLOWERS]
        return all(ask(link, f"{key}?{WHOLE};after={row};wait=30") == [whole] for key in others)


def read(endpoint: str, seconds: float, followers: Sequence[str]) -> Figures:
    """Readers with a session each; number, latency and origin of answers."""
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
                    origins[_origin(links[number], f"{key}?{where};layers={','.join(LAYERS)}")] += 1
                ms.append((time.monotonic() - began_s) * 1e3)
                time.sleep(max(0.0, EVERY_S - (time.monotonic() - began_s)))

        threads = [threading.Thread(target=reader, args=(number,)) for number in range(READERS)]
        print(json.dumps({"ready": READERS}), flush=True)
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    p50, p99 = np.percentile(ms, (50, 99)).tolist()
    shares = {"answers_per_s": sum(origins.values()) / seconds, "by_followers": 1 - origins[""] / sum(origins.values())}
    return {**shares, "answer_ms_p50": p50, "answer_ms_p99": p99}


def _origin(link: zenoh.Session, selector: str) -> str:
    """Query until answered; returns the follower, empty for the server."""
    while True:
        for reply in link.get(selector, timeout=ANSWER_S):
            if reply.ok is not None and reply.ok.attachment is not None:
                return decode_origin(reply.ok.attachment.to_bytes()).follower
        time.sleep(RETRY_S)


if __name__ == "__main__":
    print(json.dumps(read(sys.argv[1], float(sys.argv[2]), sys.argv[3:])))
