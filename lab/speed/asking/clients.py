"""Clients that ask a map server while machines send: what that costs the machines.

The clients are this module, `python -m lab.speed.asking.clients ENDPOINT SECONDS`, in a process of their own: it
prints how often they were answered, and how soon.
"""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from itertools import islice
from pathlib import Path

import numpy as np
import zenoh

from lab.speed.asking.questions import kinds
from lab.speed.fleets.fleet import Machine, samples, send
from lab.speed.measure import Report
from lab.speed.merge_restart import SITE
from lab.speed.merge_work import BATCH, batches, samples_of
from lab.speed.processes import ask, processor_s, session
from protocol.queries.parameters import selector_of
from protocol.queries.requests import MapQuery, encode_query
from protocol.wire import keys

CLIENTS, EVERY_S = 20, 1.0
MIX = {"point": 10, "region": 5, "route": 4, "way": 1}  # of their questions, each client one a second
ASKED_HOURS = 1.0  # of the work: where it is asked about
MACHINES = 10
LOADS = {"paced": 1.0, "saturated": 0.0}  # seconds from batch to batch of a machine
GOAL = 0.1  # share of what machines get acknowledged that may be lost to clients
END_S = 60.0


def ingest(endpoint: str, server: int, seconds: float, runs: int) -> list[Report]:
    """Rows: load, and medians with nobody asking and with clients that do, run by run in turn."""
    with ExitStack() as opened:
        links = [opened.enter_context(session(endpoint)) for _ in range(MACHINES)]
        fleet = [Machine(f"sender-{i:02d}", link, samples(i)) for i, link in enumerate(links)]
        rows = []
        for load, period_s in LOADS.items():
            alone, asked = list[dict[str, float]](), list[dict[str, float]]()
            for _ in range(runs):
                alone.append(_sent(server, fleet, seconds, period_s))
                with _clients(endpoint, seconds) as answers:
                    loaded = _sent(server, fleet, seconds, period_s)
                asked.append({**loaded, **answers[0]})
            rows.append(_row(load, _medians(alone), _medians(asked)))
    return rows


def _medians(runs: list[dict[str, float]]) -> dict[str, float]:
    return {key: statistics.median(run[key] for run in runs) for key in runs[0]}


def _row(load: str, alone: dict[str, float], asked: dict[str, float]) -> Report:
    loss = round(1 - asked["samples_per_s"] / alone["samples_per_s"], 3)
    return {
        "load": load,
        **{f"alone_{key}": round(value, 3) for key, value in alone.items()},
        **{f"asked_{key}": round(value, 3) for key, value in asked.items()},
        "loss": loss,
        "goal": f"loss <= {GOAL:g}",
        "met": loss <= GOAL,
    }


def _sent(server: int, fleet: list[Machine], seconds: float, period_s: float) -> dict[str, float]:
    cpu_s, start_s = processor_s(server), time.monotonic()
    result = send(fleet, seconds, period_s)
    took_s = time.monotonic() - start_s
    return {
        "samples_per_s": result.samples / took_s,
        "ack_ms_p50": float(np.percentile(result.ms, 50)),
        "ack_ms_p99": float(np.percentile(result.ms, 99)),
        "server_cores": (processor_s(server) - cpu_s) / took_s,
    }


@contextmanager
def _clients(endpoint: str, seconds: float) -> Iterator[list[dict[str, float]]]:
    """Clients that ask for so long; once left, what they print."""
    words = [sys.executable, "-m", "lab.speed.asking.clients", endpoint, str(seconds)]
    root, answers = Path(__file__).parent.parent.parent, list[dict[str, float]]()
    with subprocess.Popen(words, stdout=subprocess.PIPE, cwd=root, text=True) as child:  # noqa: S603
        try:
            if child.stdout is None or "ready" not in child.stdout.readline():
                raise RuntimeError("the clients did not start: nothing was measured")
            yield answers
            answers.append(json.loads(child.communicate(timeout=seconds + END_S)[0]))
        finally:
            child.terminate()


def main() -> None:
    """Ask for so long, and print what came of it."""
    endpoint, seconds = sys.argv[1], float(sys.argv[2])
    work = list(islice(batches(), samples_of(ASKED_HOURS) // BATCH))
    draw, some = np.random.default_rng(1), kinds(work)
    pool = {name: list(islice(some[name], CLIENTS)) for name in MIX}
    shares = np.array(list(MIX.values())) / sum(MIX.values())
    turns = max(1, round(seconds / EVERY_S))
    chosen = draw.choice(list(MIX), (CLIENTS, turns), p=shares).tolist()
    plans = [[pool[name][int(draw.integers(CLIENTS))] for name in names] for names in chosen]
    took_ms, refused = list[float](), list[str]()
    with ExitStack() as opened:
        links = [opened.enter_context(session(endpoint)) for _ in range(CLIENTS)]
        print(json.dumps({"ready": CLIENTS}), flush=True)
        start_s = time.monotonic()

        def client(number: int) -> None:
            for turn, query in enumerate(plans[number]):
                due_s = start_s + EVERY_S * (turn + number / CLIENTS)
                time.sleep(max(0.0, due_s - time.monotonic()))
                began_s = time.monotonic()
                try:
                    _ask(links[number], query)
                except RuntimeError:  # refused: too many wait
                    refused.append(query.name)
                else:
                    took_ms.append(1e3 * (time.monotonic() - began_s))

        threads = [threading.Thread(target=client, args=(number,)) for number in range(CLIENTS)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    p50, p99 = np.percentile(took_ms, (50, 99)).tolist()
    print(json.dumps({"answers": len(took_ms), "refused": len(refused), "ms_p50": p50, "ms_p99": p99}))


def _ask(link: zenoh.Session, query: MapQuery) -> None:
    ask(link, f"{keys.map_query(SITE.name, query.name)}?{selector_of(encode_query(query))}")


if __name__ == "__main__":
    main()
