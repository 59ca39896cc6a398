"""Query latency of a real map server with a day of work, while ten machines send.

Each query is followed by one to a null service that replies with equally many bytes: the transport's share. It is this
module in its own process, `python -m lab.speed.query ENDPOINT`.
"""

from __future__ import annotations

import json
import math
import statistics
import sys
import tempfile
import threading
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import zenoh

from lab.speed.measure import Figures, child, rows_of, timed
from lab.speed.site import SITE, Site, ask, ask_map, meanwhile, send, session, settle
from mapserver.query.routes import DETOUR, LEAST_DETOUR_M
from protocol.arrays import Floats, Table
from protocol.queries.places import Place
from protocol.queries.request import MapQuery
from protocol.queries.requests import InfoQuery, PointQuery, PointsQuery, RegionQuery
from protocol.queries.route_requests import RouteQuery, WayQuery
from protocol.site.geometry import Bounds
from protocol.wire.messages import SampleBatch
from sitegrid.proof.figures import Row
from tests.site_work import BATCH, HOURS, SPACING_M, Batches, batches, samples_of, seconds_of, write_store

OPTIONS = {"hours": HOURS, "queries": 200}
GOALS = {
    ("warm point", "times_empty"): "<= 2",
    ("warm region", "over_empty_ms"): "<= 5",
    ("warm route", "over_empty_ms"): "<= 8",
    ("warm way", "ms_p50"): "<= 250",
    ("warm info", "ms_p50"): "<= 2",
    ("warm as_of", "ms_p50"): "<= 30",
}
EMPTY_KEY = "bench/empty"
COLD = 10  # queries to a fresh server; with more, later ones would profit from earlier ones
SLOW_KINDS = {"as_of": 10, "way": 4}  # slow kinds: one in so many queries
REGION_M, LAYERS = 256.0, ("resistance", "grade", "confidence")
PLACES = 1000  # per points query
ROUTE_M, CORNER_M = 2000.0, 10.0
SEARCHED_M, OFF = 500.0, 0.1  # edge of the square searched for a way, and its tolerance


def run(hours: float, queries: int) -> Iterator[Row]:
    """Queries of each kind after `hours` of work.

    cold: on a fresh server, one per kind. warm: repeated, while samples arrive.
    """
    work, sent = batches(), Counter[str]()
    before, after = list(islice(work, samples_of(hours) // BATCH)), seconds_of(work)
    asked = {name: list(islice(some, -(-queries // SLOW_KINDS.get(name, 1)))) for name, some in kinds(before).items()}
    with tempfile.TemporaryDirectory() as path, Site(Path(path)) as site:
        write_store(Path(path), SITE, len(before), tail_rows=0)
        with child("lab.speed.query", site.endpoint), session(site.endpoint) as link:
            for name, questions in asked.items():
                with _at_work(site, after, sent):
                    yield from rows_of(f"cold {name}", _answered(link, questions[:COLD]))
            with _at_work(site, after, sent):
                for name, questions in asked.items():
                    for question in questions:
                        ask_map(link, question)
                    yield from rows_of(f"warm {name}", _answered(link, questions))


def _answered(link: zenoh.Session, queries: Sequence[MapQuery[Any]]) -> Figures:
    took_ms, empty_ms = [], []
    for query in queries:
        answers: list[bytes] = []
        took_ms.append(1e3 * timed(lambda: answers.extend(ask_map(link, query)))["wall_s"])  # noqa: B023 # called at once
        size = sum(map(len, answers))
        empty_ms.append(1e3 * timed(lambda: ask(link, f"{EMPTY_KEY}?{size}"))["wall_s"])  # noqa: B023
    median, empty = statistics.median(took_ms), statistics.median(empty_ms)
    return {
        "ms_p50": median,
        "ms_p99": float(np.percentile(took_ms, 99)),
        "empty_ms_p50": empty,
        "times_empty": median / empty,
        "over_empty_ms": median - empty,
    }


@contextmanager
def _at_work(site: Site, seconds: Iterator[Batches], sent: Counter[str]) -> Iterator[None]:
    """A fresh, settled server with sending machines."""
    with site.serving() as server:
        settle(server)
        with meanwhile(partial(_send, site.endpoint, seconds, sent)):
            yield


def _send(endpoint: str, seconds: Iterator[Batches], sent: Counter[str], ended: threading.Event) -> None:
    """Send a second of samples every second, in its own session. sent: samples by machine."""
    with session(endpoint) as link:
        for second in seconds:
            for name, rows in second:
                send(link, SampleBatch(name, 2, sent[name] + 1, rows, SITE.frame))
                sent[name] += len(rows)
            if ended.wait(1.0):
                return


# --- what is asked ---------------------------------------------------------------------------------------------------


def kinds(work: Batches) -> dict[str, Iterator[MapQuery[Any]]]:
    """Endless queries by kind, each at another place. as_of: a point at any time of the work."""
    driven = np.concatenate([rows for _, rows in work])
    draw = np.random.default_rng(0)
    order = draw.permutation(len(driven))
    cells, firsts = np.unique(np.floor([driven[name][order] for name in ("x_m", "y_m")]), axis=1, return_index=True)
    scattered = cells[:, np.argsort(firsts)].T  # in random order, each once
    places = iter(scattered.tolist())
    half, stamps = REGION_M / 2, driven["stamp_ns"]
    return {
        "point": (PointQuery(x, y, LAYERS) for x, y in places),
        "points": (PointsQuery(_some(scattered, draw), LAYERS) for _ in places),
        "region": (RegionQuery(Bounds(x - half, y - half, x + half, y + half), LAYERS) for x, y in places),
        "route": (RouteQuery(line) for line in _lines(work, draw)),
        "way": (WayQuery(start, end) for start, end in _ends(scattered, draw)),
        "info": iter(InfoQuery, None),
        "as_of": (PointQuery(x, y, LAYERS, as_of_ns=int(draw.choice(stamps))) for x, y in places),
    }


def _some(places: Floats, draw: np.random.Generator) -> tuple[Place, ...]:
    return tuple(map(tuple, draw.choice(places, PLACES, replace=False).tolist()))


def _lines(work: Batches, draw: np.random.Generator) -> Iterator[tuple[Place, ...]]:
    """Lines that machines drove."""
    names = sorted({name for name, _ in work})
    tracks: Sequence[Table] = [np.concatenate([rows for other, rows in work if other == name]) for name in names]
    count, every = round(ROUTE_M / SPACING_M), round(CORNER_M / SPACING_M)
    while True:
        track = tracks[int(draw.integers(len(tracks)))]
        first = int(draw.integers(max(1, len(track) - count)))
        own = track[first : first + count + 1 : every]
        yield tuple(zip(own["x_m"].tolist(), own["y_m"].tolist(), strict=True))


def _ends(places: Floats, draw: np.random.Generator) -> Iterator[tuple[Place, Place]]:
    """Ends of ways whose search square of about SEARCHED_M is on the site."""
    low, high = places.min(axis=0), places.max(axis=0)
    while True:
        start, end = draw.choice(places, 2, replace=False)
        reach_m = LEAST_DETOUR_M + DETOUR * math.dist(start, end)
        corner, other = np.minimum(start, end) - reach_m, np.maximum(start, end) + reach_m
        is_square = (np.abs((other - corner) / SEARCHED_M - 1) < OFF).all()
        if is_square and (corner >= low).all() and (other <= high).all():
            yield tuple(start.tolist()), tuple(end.tolist())


# --- in a process of its own -----------------------------------------------------------------------------------------


def serve_empty(endpoint: str) -> None:
    """Reply with the requested number of bytes, until ended."""
    with session(endpoint) as link:

        def reply(query: zenoh.Query) -> None:
            with query:
                query.reply(query.key_expr, bytes(int(str(query.parameters))))

        with link.declare_queryable(EMPTY_KEY, reply):
            print(json.dumps({"ready": EMPTY_KEY}), flush=True)
            threading.Event().wait()


if __name__ == "__main__":
    serve_empty(sys.argv[1])
