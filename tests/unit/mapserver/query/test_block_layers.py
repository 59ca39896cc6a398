"""Kept layers and their answers equal those of a new server, derived again where needed, also after a repair."""

from __future__ import annotations

import tempfile
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapserver.evidence.grid import Grid
from mapserver.ingest.writer import Writer
from mapserver.journal.facts import NO_FACTS
from mapserver.layers.cell_layers import LAYERS
from mapserver.layers.gap_filling import AREA_LAYERS
from mapserver.query.block_layers import BlockLayers
from protocol.arrays import Table
from protocol.queries.answer_codec import decode_point
from protocol.queries.requests import PointQuery, PointsQuery, RegionQuery, WhyQuery
from protocol.queries.roads import SegmentsQuery, WorklistQuery
from protocol.queries.route_requests import RouteQuery, WayQuery
from protocol.site.geometry import BLOCK_CELLS, Bounds, CellWindow
from tests.unit.mapserver.data import CONFIG, SITE, incoming, open_writer, random_samples, samples, send
from tests.unit.mapserver.query.fake_upkeep import answered, answers_of
from tests.unit.mapserver.roads.drives import START_NS, along, passes

ALL = (*LAYERS, *AREA_LAYERS)
WINDOW = CellWindow(-70, -45, 130, 100)


def read(kept: BlockLayers, writer: Writer, window: CellWindow = WINDOW, names: tuple[str, ...] = ALL):
    return kept.read(writer.run(lambda state: kept.look(state, window, names)), window, names)


def fresh() -> BlockLayers:
    return BlockLayers(SITE.cell_m, CONFIG)


def same(a, b) -> None:
    assert a.keys() == b.keys()
    for name, layer in a.items():
        np.testing.assert_array_equal(layer, b[name], err_msg=name)


def test_another_grid_begins_anew_and_an_old_look_keeps_nothing(tmp_path):
    kept, names, window = fresh(), ("resistance", "resistance_filled"), CellWindow(0, 0, 40, 40)
    with closing(open_writer(tmp_path)) as writer:
        send(writer, [incoming(random_samples(500, seed=2))])
        old = writer.run(lambda state: kept.look(state, window, names))
        expected = read(fresh(), writer, window, names)

        class Other:
            site, config, facts = SITE, CONFIG, NO_FACTS
            grid = Grid(SITE.cell_m, CONFIG.fold)
            version, newest_ns = old.version, 0

        empty = kept.read(kept.look(Other(), window, names), window, names)  # type: ignore[arg-type]
        assert np.isnan(empty["resistance_filled"]).all()
        same(kept.read(old, window, names), expected)
        assert np.isnan(kept.read(kept.look(Other(), window, names), window, names)["resistance"]).all()  # type: ignore[arg-type]


def test_so_much_is_kept_and_no_more(tmp_path):
    names = ("resistance", "resistance_filled")
    kept = BlockLayers(SITE.cell_m, CONFIG, most=60)
    with closing(open_writer(tmp_path)) as writer:
        send(writer, [incoming(random_samples(3000, seed=1))])
        for _ in range(3):
            same(read(kept, writer, names=names), read(fresh(), writer, names=names))
            assert kept._count <= 60
            held = [
                layer for store in (kept._cells, kept._areas) for one in store.values() for layer in one.layers.values()
            ]
            assert sum(layer.size for layer in held) == kept._count * BLOCK_CELLS**2


def test_beside_new_samples_no_block_is_derived_again_whose_pages_count_as_before(tmp_path):
    names, wide = ("resistance", "changed_s"), CellWindow(-320, -16, 640, 32)
    kept = fresh()
    with closing(open_writer(tmp_path)) as writer:
        send(writer, [incoming(samples(600, x_m=np.arange(-300, 300) + 0.5, y_m=0.5, distance_m=4.0))])
        read(kept, writer, wide, names)
        derived, turn = kept.derived, writer.run(lambda state: state.grid.folded_since(-1)[1])
        more = samples(5, x_m=np.arange(5) + 0.5, y_m=0.5, distance_m=4.0)
        more["stamp_ns"] += 10**12
        send(writer, [incoming(more, first_seq=601)])
        same(read(kept, writer, wide, names), read(fresh(), writer, wide, names))
        folded = writer.run(lambda state: state.grid.folded_since(turn)[0])
        assert kept.derived - derived == len(folded) > 0


def test_a_point_that_is_kept_is_what_its_region_says_until_something_comes_in_beside_it(tmp_path):
    names = ("resistance", "grade", "changed_s")
    with closing(open_writer(tmp_path)) as writer:
        answers, asked = answers_of(writer), {"x": "0.5", "y": "0.5", "layers": "resistance,grade"}
        send(writer, [incoming(samples(600, x_m=np.arange(-300, 300) + 0.5, y_m=0.5, distance_m=4.0))])

        def kept_cell(cell: tuple[int, int], names: tuple[str, ...]) -> dict[str, float] | None:
            return writer.run(lambda state: answers._layers.kept_cell(state, cell, names))

        assert kept_cell((0, 0), names[:2]) is None, "nobody has asked yet"
        first = answered(answers, "point", asked)
        assert answered(answers, "point", asked) == first
        assert kept_cell((0, 0), names[:2]) == decode_point(first).values
        assert kept_cell((0, 0), names) is None, "one of its layers is not kept"
        aged = {**asked, "layers": "resistance,age_s"}
        of_region = answered(answers, "point", aged)
        assert kept_cell((0, 0), ("resistance", "age_s")) == decode_point(of_region).values
        assert answered(answers, "point", aged) == of_region
        assert kept_cell((5000, 5000), names[:2]) is None
        more = samples(5, x_m=np.arange(5) + 17.5, y_m=0.5, distance_m=4.0, c_rr=0.2)
        more["stamp_ns"] += 10**12
        send(writer, [incoming(more, first_seq=601)])
        assert kept_cell((0, 0), names[:2]) is None, "whether the ground changed is seen with its surroundings"
        again = decode_point(answered(answers, "point", asked))
        assert again.version.row == 2
        assert again.values == decode_point(first).values


LINE = along([(-60, -20), (60, 10)])
ENDS = ((-50.0, -17.5), (50.0, 7.5))
metres = st.integers(-60, 60).map(float)
names = st.lists(st.sampled_from((*LAYERS, *AREA_LAYERS)), max_size=4, unique=True).map(tuple)
bounds = st.builds(
    lambda west, south, width, height: Bounds(west, south, west + width, south + height),
    *(metres, metres, st.integers(1, 90), st.integers(1, 90)),
)
asked = st.one_of(
    st.builds(PointQuery, metres, metres, names),
    st.builds(
        PointsQuery,
        st.lists(st.tuples(metres, metres), min_size=1, max_size=4).map(tuple),
        names,
    ),
    st.builds(RegionQuery, bounds, names),
    st.builds(WhyQuery, metres, metres),
    st.builds(SegmentsQuery, bounds=st.none() | bounds),
    st.builds(WorklistQuery, st.sampled_from([0.01, 0.03])),
    st.builds(RouteQuery, st.just(ENDS)),
    st.just(WayQuery(*ENDS)),
)
some = st.tuples(st.just("some"), st.integers(0, 9), st.tuples(metres, metres))
passing = st.tuples(st.just("passes"), st.integers(0, 9), st.sampled_from([0.02, 0.06]))


def rows_of(what: str, seed: int, more: object, turn: int) -> Table:
    """Samples around a place, or road passes on ground of a resistance; each turn is later."""
    if what == "passes":
        return passes(LINE, 3, more, seed=seed, after_s=400.0 * turn)  # type: ignore[arg-type]
    rows = random_samples(80, seed, half_m=8.0)
    rows["x_m"] += more[0]  # type: ignore[index]
    rows["y_m"] += more[1]  # type: ignore[index]
    rows["stamp_ns"] = START_NS + turn * 400 * 10**9 + np.arange(80) * 10**9
    return rows


@pytest.mark.slow
@settings(max_examples=6)
@given(st.lists(some | passing | asked, min_size=2, max_size=14))
def test_an_answer_is_that_of_a_server_that_begins_now(course):
    with tempfile.TemporaryDirectory() as folder, closing(open_writer(Path(folder))) as writer:
        kept = answers_of(writer)
        for turn, step in enumerate([("passes", 1, 0.06), *course]):
            if isinstance(step, tuple):
                send(writer, [incoming(rows_of(*step, turn), 1, "ab"[turn % 2], spool_id=1 + turn)])
                continue
            kept.examine_roads()
            newest = writer.run(lambda store: store.merged)
            words = step.parameters() if isinstance(step, WhyQuery) else {**step.parameters(), "after": str(newest)}
            fresh = answers_of(writer)
            assert answered(kept, step.name, words) == answered(fresh, step.name, words)
