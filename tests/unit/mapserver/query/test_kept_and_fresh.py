"""Whatever was asked and came in before: an answer is, byte for byte, that of a server that begins now."""

import tempfile
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapserver.layers.cell_layers import LAYERS
from mapserver.layers.gap_filling import AREA_LAYERS
from protocol.arrays import Table
from protocol.queries.requests import PointQuery, PointsQuery, RegionQuery, When, WhyQuery, encode_query
from protocol.queries.roads import SegmentsQuery, WorklistQuery
from protocol.queries.route_requests import RouteQuery, WayQuery
from protocol.site.geometry import Bounds
from tests.unit.mapserver.data import incoming, open_writer, random_samples, send
from tests.unit.mapserver.query.fake_upkeep import answered, answers_of
from tests.unit.mapserver.roads.drives import START_NS, along, passes

LINE = along([(-60, -20), (60, 10)])
ENDS = ((-50.0, -17.5), (50.0, 7.5))
metres = st.integers(-60, 60).map(float)
names = st.lists(st.sampled_from((*LAYERS, *AREA_LAYERS)), max_size=4, unique=True).map(tuple)
times = st.booleans().map(lambda repairs: When(repairs=repairs))
bounds = st.builds(
    lambda west, south, width, height: Bounds(west, south, west + width, south + height),
    *(metres, metres, st.integers(1, 90), st.integers(1, 90)),
)
asked = st.one_of(
    st.builds(PointQuery, metres, metres, names, when=times),
    st.builds(PointsQuery, st.lists(st.tuples(metres, metres), min_size=1, max_size=4).map(tuple), names, when=times),
    st.builds(RegionQuery, bounds, names, when=times),
    st.builds(WhyQuery, metres, metres),
    st.builds(SegmentsQuery, bounds=st.none() | bounds),
    st.builds(WorklistQuery, st.sampled_from([0.01, 0.03])),
    st.builds(RouteQuery, st.just(ENDS), repairs=st.booleans()),
    st.just(WayQuery(*ENDS)),
)
some = st.tuples(st.just("some"), st.integers(0, 9), st.tuples(metres, metres))
passing = st.tuples(st.just("passes"), st.integers(0, 9), st.sampled_from([0.02, 0.06]))


def rows_of(what: str, seed: int, more: object, turn: int) -> Table:
    """Samples around a place, or some passes of the road on ground of a resistance; each turn is later."""
    if what == "passes":
        return passes(LINE, 3, more, seed=seed, after_s=400.0 * turn)  # type: ignore[arg-type]
    rows = random_samples(80, seed, half_m=8.0)
    rows["x_m"] += more[0]  # type: ignore[index]
    rows["y_m"] += more[1]  # type: ignore[index]
    rows["stamp_ns"] = START_NS + turn * 400 * 10**9 + np.arange(80) * 10**9
    return rows


@pytest.mark.slow
@settings(max_examples=15)
@given(st.lists(some | passing | asked, min_size=2, max_size=14))
def test_an_answer_is_that_of_a_server_that_begins_now(course):
    with tempfile.TemporaryDirectory() as folder, closing(open_writer(Path(folder))) as writer:
        kept = answers_of(writer)
        for turn, step in enumerate([("passes", 1, 0.06), *course]):
            if isinstance(step, tuple):
                send(writer, [incoming(rows_of(*step, turn), 1, "ab"[turn % 2], spool_id=1 + turn)])
                continue
            newest = writer.run(lambda store: store.merged)
            words = encode_query(step) if isinstance(step, WhyQuery) else {**encode_query(step), "after": str(newest)}
            fresh = answers_of(writer)
            assert answered(kept, step.name, words) == answered(fresh, step.name, words)
