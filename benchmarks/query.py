"""Milliseconds until a query is answered: a real map server with a day of work, while ten machines go on sending.

Each query is followed by one to a service that answers at once with as many bytes: what the journey alone takes.
"""

from __future__ import annotations

import statistics
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path

import numpy as np
import zenoh

from benchmarks.measure import Report, machine
from benchmarks.merge_restart import SITE, build
from benchmarks.merge_work import BATCH, Batches, batches, samples_of, seconds_of
from benchmarks.processes import EMPTY_KEY, ask, process, send, served, session
from protocol.arrays import Table
from protocol.queries.parameters import selector_of
from protocol.queries.requests import InfoQuery, MapQuery, PointQuery, RegionQuery, When, encode_query
from protocol.site.geometry import Bounds
from protocol.wire import keys
from protocol.wire.messages import SampleBatch

GOALS_MS = {"point": 3.0, "region": 40.0, "info": 2.0, "as_of": 30.0}
REGION_M, LAYERS = 256.0, ("resistance", "grade", "confidence")
PAST_SHARE = 10  # as of a time, one in so many queries is asked: it may take seconds


def run(hours: float, queries: int) -> Report:
    """Ask so many queries of each kind after so many hours of work.

    Rows: state, query, median and 99th percentile of the milliseconds until it is answered, and the median of the
    service that answers at once. cold: asked of a server that has just come, and looks for changes everywhere; warm:
    once all of the site was read. The places are random ones where somebody drove, each is asked for once. as_of: a
    point, as of any time of the work.
    """
    work = batches()
    before = list(islice(work, samples_of(hours) // BATCH))
    driven = np.concatenate([rows for _, rows in before])
    with tempfile.TemporaryDirectory() as path:
        build(Path(path), len(before), tail_rows=0)
        with served(Path(path), SITE) as (endpoint, _), process("benchmarks.processes", endpoint):
            rows = list(_measured(endpoint, driven, seconds_of(work), queries))
    return {"benchmark": "query", "hours": hours, "queries": queries, **machine(), "rows": rows}


def _measured(
    endpoint: str, driven: Table, seconds: Iterator[Batches], queries: int
) -> Iterator[dict[str, str | float]]:
    asked = _queries(driven)
    with session(endpoint) as link, _sending(endpoint, seconds):
        for state in ("cold", "warm"):
            if state == "warm":
                _bytes_of(link, RegionQuery(_bounds(driven), LAYERS[:1]))
            for name, query in asked.items():
                count = max(1, queries // PAST_SHARE) if name == "as_of" else queries
                yield {"state": state, "query": name, **_answered(link, islice(query, count)), "goal": GOALS_MS[name]}


def _answered(link: zenoh.Session, queries: Iterator[MapQuery]) -> dict[str, float]:
    took_ms, empty_ms = [], []
    for query in queries:
        size, ms = _timed(lambda: _bytes_of(link, query))  # noqa: B023 # called at once
        took_ms.append(ms)
        _, ms = _timed(lambda: len(ask(link, f"{EMPTY_KEY}?{size}")[0]))  # noqa: B023
        empty_ms.append(ms)
    return {
        "queries": len(took_ms),
        "ms_median": round(statistics.median(took_ms), 3),
        "ms_p99": round(float(np.percentile(took_ms, 99)), 3),
        "empty_ms_median": round(statistics.median(empty_ms), 3),
    }


def _queries(driven: Table) -> dict[str, Iterator[MapQuery]]:
    """Endless queries of each kind."""
    draw = np.random.default_rng(0)
    order = draw.permutation(len(driven))
    cells, firsts = np.unique(np.floor([driven[name][order] for name in ("x_m", "y_m")]), axis=1, return_index=True)
    places = iter(cells[:, np.argsort(firsts)].T.tolist())  # in random order, each once
    half, stamps = REGION_M / 2, driven["stamp_ns"]
    as_of = ((x, y, int(draw.choice(stamps))) for x, y in places)
    return {
        "point": (PointQuery(x, y, LAYERS) for x, y in places),
        "region": (RegionQuery(Bounds(x - half, y - half, x + half, y + half), LAYERS) for x, y in places),
        "info": iter(InfoQuery, None),
        "as_of": (PointQuery(x, y, LAYERS, when=When(as_of_ns)) for x, y, as_of_ns in as_of),
    }


def _bounds(driven: Table) -> Bounds:
    x, y = driven["x_m"], driven["y_m"]
    return Bounds(float(x.min()), float(y.min()), float(x.max()), float(y.max()))


def _bytes_of(link: zenoh.Session, query: MapQuery) -> int:
    """How many bytes the answer has."""
    key, parameters = keys.map_query(SITE.name, query.name), selector_of(encode_query(query))
    return sum(map(len, ask(link, f"{key}?{parameters}")))


def _timed(work: Callable[[], int]) -> tuple[int, float]:
    start_s = time.perf_counter()
    result = work()
    return result, (time.perf_counter() - start_s) * 1e3


@contextmanager
def _sending(endpoint: str, seconds: Iterator[Batches]) -> Iterator[None]:
    """Machines that send their samples every second, from a session of their own."""
    ended, problems = threading.Event(), list[Exception]()

    def drive() -> None:
        sent: Counter[str] = Counter()
        try:
            with session(endpoint) as link:
                for second in seconds:
                    for name, rows in second:
                        send(link, SITE, SampleBatch(name, 2, sent[name] + 1, rows, SITE.frame))
                        sent[name] += len(rows)
                    if ended.wait(1.0):
                        return
        except Exception as error:  # handed on below
            problems.append(error)

    driver = threading.Thread(target=drive)
    driver.start()
    try:
        yield
    finally:
        ended.set()
        driver.join()
    if problems:
        raise RuntimeError("the machines stopped sending") from problems[0]
