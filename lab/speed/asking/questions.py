"""What is asked of a map server in benchmarks: queries of each kind, about places where somebody drove."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from lab.speed.merge_work import SPACING_M, Batches
from mapserver.query.routes import DETOUR, LEAST_DETOUR_M
from protocol.arrays import Floats, Table
from protocol.queries.places import Place
from protocol.queries.requests import InfoQuery, MapQuery, PointQuery, PointsQuery, RegionQuery, When
from protocol.queries.route_requests import RouteQuery, WayQuery
from protocol.site.geometry import Bounds

REGION_M, LAYERS = 256.0, ("resistance", "grade", "confidence")
PLACES = 1000  # of one query for points
ROUTE_M, CORNER_M = 2000.0, 10.0
SEARCHED_M, OFF = 500.0, 0.1  # edge of the square that a way is looked for in, and by which share it may differ


def kinds(work: Batches) -> dict[str, Iterator[MapQuery]]:
    """Endless queries of each kind after so much work; each about other places. as_of: a point as of any time of it."""
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
        "as_of": (PointQuery(x, y, LAYERS, when=When(as_of_ns=int(draw.choice(stamps)))) for x, y in places),
    }


def _some(places: Floats, draw: np.random.Generator) -> tuple[Place, ...]:
    return tuple(map(tuple, draw.choice(places, PLACES, replace=False).tolist()))


def _lines(work: Batches, draw: np.random.Generator) -> Iterator[tuple[Place, ...]]:
    """What a machine drove in a while."""
    names = sorted({name for name, _ in work})
    tracks: Sequence[Table] = [np.concatenate([rows for other, rows in work if other == name]) for name in names]
    count, every = round(ROUTE_M / SPACING_M), round(CORNER_M / SPACING_M)
    while True:
        track = tracks[int(draw.integers(len(tracks)))]
        first = int(draw.integers(max(1, len(track) - count)))
        own = track[first : first + count + 1 : every]
        yield tuple(zip(own["x_m"].tolist(), own["y_m"].tolist(), strict=True))


def _ends(places: Floats, draw: np.random.Generator) -> Iterator[tuple[Place, Place]]:
    """Places between which a way is looked for in a square of about SEARCHED_M, all of it within the site."""
    low, high = places.min(axis=0), places.max(axis=0)
    while True:
        start, end = draw.choice(places, 2, replace=False)
        reach_m = LEAST_DETOUR_M + DETOUR * math.dist(start, end)
        corner, other = np.minimum(start, end) - reach_m, np.maximum(start, end) + reach_m
        is_square = (np.abs((other - corner) / SEARCHED_M - 1) < OFF).all()
        if is_square and (corner >= low).all() and (other <= high).all():
            yield tuple(start.tolist()), tuple(end.tolist())
