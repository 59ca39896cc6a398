"""Milliseconds until a query is answered: a real map server with a day of work, while ten machines go on sending.

Each query is followed by one to a service that answers at once with as many bytes: what the journey alone takes.
"""

from __future__ import annotations

import statistics
import tempfile
import threading
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from itertools import islice
from pathlib import Path

import numpy as np
import zenoh

from lab.speed.asking.clients import ingest
from lab.speed.asking.questions import kinds
from lab.speed.measure import Report, machine, timed
from lab.speed.merge_restart import SITE, build
from lab.speed.merge_work import BATCH, Batches, batches, samples_of, seconds_of
from lab.speed.processes import EMPTY_KEY, ask, at_work, process, routed, send, serving, session, settle
from protocol.queries.parameters import selector_of
from protocol.queries.requests import MapQuery, encode_query
from protocol.wire import keys
from protocol.wire.messages import SampleBatch

COLD = 10  # questions to a server that has just come: more of them, and the later ones find what earlier ones left
PAST_SHARE, WAY_SHARE = 10, 4  # one in so many queries is asked of those that take long
# Of what is kept: times the empty query, milliseconds beyond it, or milliseconds.
GOALS = {
    "point": ("of_empty", 2.0),
    "region": ("over_ms", 5.0),
    "route": ("over_ms", 8.0),
    "way": ("ms_median", 250.0),
    "info": ("ms_median", 2.0),
    "as_of": ("ms_median", 30.0),
}


def run(hours: float, queries: int, seconds: float, runs: int) -> Report:
    """Ask so many queries of each kind after so many hours of work; then have 20 clients ask while machines send.

    Rows: state, query, median and 99th percentile of the milliseconds until it is answered, and beside them those of
    the service that answers at once: its median, how many times that the query's is, and how far beyond. cold: asked of
    a server that has just come, one for each kind. warm: what was asked once before, while samples came in. ingest:
    samples per second that are acknowledged while nobody asks and while clients do, medians of so many runs of so many
    seconds, in turn.
    """
    work = batches()
    before = list(islice(work, samples_of(hours) // BATCH))
    after = seconds_of(work)
    rows: list[Report] = []
    sent: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as path, routed() as (endpoint, _), process("lab.speed.processes", endpoint):
        build(Path(path), len(before), tail_rows=0)
        asked = {name: list(islice(some, _count(name, queries))) for name, some in kinds(before).items()}
        with session(endpoint) as link:
            for name, questions in asked.items():
                with _serving(endpoint, Path(path), after, sent):
                    rows.append({"state": "cold", "query": name, **_answered(link, questions[:COLD])})
            with _serving(endpoint, Path(path), after, sent):
                for name, questions in asked.items():
                    for question in questions:
                        _bytes_of(link, question)
                    rows.append({"state": "warm", "query": name, **_judged(name, _answered(link, questions))})
        with serving(endpoint, Path(path), SITE) as pid:
            settle(pid)
            loads = ingest(endpoint, pid, seconds, runs)
    counts = {"hours": hours, "queries": queries, "seconds": seconds, "runs": runs}
    return {"benchmark": "query", **counts, **machine(), "rows": rows, "ingest": loads}


def _count(name: str, queries: int) -> int:
    return max(1, queries // {"as_of": PAST_SHARE, "way": WAY_SHARE}.get(name, 1))


def _judged(name: str, figures: dict[str, float]) -> Report:
    if name not in GOALS:
        return {**figures, "goal": None, "met": None}
    figure, limit = GOALS[name]
    return {**figures, "goal": f"{figure} <= {limit:g}", "met": figures[figure] <= limit}


def _answered(link: zenoh.Session, queries: Sequence[MapQuery]) -> dict[str, float]:
    took_ms, empty_ms = [], []
    for query in queries:
        sizes: list[int] = []
        took_ms.append(1e3 * timed(lambda: sizes.append(_bytes_of(link, query))))  # noqa: B023 # called at once
        empty_ms.append(1e3 * timed(lambda: ask(link, f"{EMPTY_KEY}?{sizes[0]}")))  # noqa: B023
    median, empty = statistics.median(took_ms), statistics.median(empty_ms)
    return {
        "queries": len(took_ms),
        "ms_median": round(median, 3),
        "ms_p99": round(float(np.percentile(took_ms, 99)), 3),
        "empty_ms_median": round(empty, 3),
        "of_empty": round(median / empty, 2),
        "over_ms": round(median - empty, 3),
    }


def _bytes_of(link: zenoh.Session, query: MapQuery) -> int:
    """How many bytes the answer has."""
    key, parameters = keys.map_query(SITE.name, query.name), selector_of(encode_query(query))
    return sum(map(len, ask(link, f"{key}?{parameters}")))


@contextmanager
def _serving(endpoint: str, folder: Path, seconds: Iterator[Batches], sent: Counter[str]) -> Iterator[None]:
    """A server that has just come and is done with that, to which machines send."""
    with serving(endpoint, folder, SITE) as pid:
        settle(pid)
        with at_work(partial(_send, endpoint, seconds, sent)):
            yield


def _send(endpoint: str, seconds: Iterator[Batches], sent: Counter[str], ended: threading.Event) -> None:
    """Send every second what machines sample, from a session of its own. sent: samples of each so far."""
    with session(endpoint) as link:
        for second in seconds:
            for name, rows in second:
                send(link, SITE, SampleBatch(name, 2, sent[name] + 1, rows, SITE.frame))
                sent[name] += len(rows)
            if ended.wait(1.0):
                return
