from contextlib import closing
from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from mapserver.ingest.store import Store
from mapserver.ingest.writer import Writer
from mapserver.query.answering import Answers
from mapserver.query.block_layers import BlockLayers
from protocol.errors import QueryError, Refusal
from protocol.queries.coverage import CoverageQuery
from protocol.queries.lanes import LanesQuery
from protocol.queries.requests import HistoryQuery, PointQuery, PointsQuery, RegionQuery, WhyQuery
from protocol.queries.roads import SegmentsQuery, WorklistQuery
from protocol.queries.route_requests import RouteQuery, WayQuery
from protocol.site.geometry import Bounds
from tests.unit.mapserver.data import CONFIG, NOW_NS, SITE, incoming, open_writer, refused, samples, send
from tests.unit.mapserver.query.fake_upkeep import answers_of

# A sample per cell of two diagonals; the value names the cell.
STEPS = np.arange(-40, 40)


def diagonal() -> np.ndarray:
    return samples(len(STEPS), x_m=STEPS + 0.5, y_m=-STEPS - 0.5, grade_e=STEPS / 100, distance_m=8.0)


@pytest.fixture(scope="module")
def answers(tmp_path_factory):
    with closing(open_writer(tmp_path_factory.mktemp("store"))) as writer:
        send(writer, [incoming(diagonal())])
        yield answers_of(writer)


def region(answers: Answers, *bounds: float, names: tuple[str, ...] = ("grade_east",)):
    return answers.region(RegionQuery(Bounds(*bounds), names))


def test_a_point_is_the_cell_that_it_lies_in(answers):
    for step, within in product((-40, -17, -16, -1, 0, 15, 16, 39), (0.0, 0.5, 0.999)):
        point = answers.point(PointQuery(step + within, -step - within - 0.001, ("grade_east",)))
        assert (point.x_m, point.y_m) == (step + 0.5, -step - 0.5)
        assert point.values["grade_east"] == pytest.approx(step / 100, abs=1e-3)
        assert (point.merged, point.stamp_ns) == (1, NOW_NS + 79 * 10**9)


@pytest.mark.parametrize(
    "bounds",
    [(-45, -45, 45, 45), (-20, -3, 3, 20), (3, -16, 13, -3), (-16, 0, 0, 16), (0, -1, 1, 0), (-0.5, -0.5, 0.5, 0.5)],
)
def test_a_region_is_cut_from_its_blocks(answers, bounds):
    here = region(answers, *bounds)
    west, south = int(np.floor(bounds[0])), int(np.floor(bounds[1]))
    expected = np.full((len(here.y_m), len(here.x_m)), np.nan)
    for step in STEPS:
        column, row = step - west, -step - 1 - south
        if 0 <= column < expected.shape[1] and 0 <= row < expected.shape[0]:
            expected[row, column] = step / 100
    assert (here.x_m[0], here.y_m[0]) == (west + 0.5, south + 0.5)
    np.testing.assert_allclose(here["grade_east"], expected, atol=1e-3)
    assert np.isfinite(expected).any()


def test_a_region_that_no_reply_carries_is_refused(answers):
    bounds = Bounds(0, 0, 5000, 4000)
    for query in (RegionQuery(bounds), RegionQuery(bounds, resolution_m=1000.0), RegionQuery(bounds, as_of_ns=1)):
        with refused(Refusal.TOO_LARGE, "5000 x 4000 cells"):
            answers.region(query)


PLACES = ((-40.0, 40.0), (39.0, -39.0))
TOO_MUCH = [
    RegionQuery(Bounds(-45, -45, 45, 45), ("visits",)),
    RegionQuery(Bounds(-45, -45, 45, 45), ("grade_east",), resolution_m=30.0),
    RegionQuery(Bounds(-45, -45, 45, 45), ("resistance_filled",)),
    PointsQuery(tuple((x + 0.5, -x - 0.5) for x in range(-40, 40, 10)), ("visits",)),
    PointsQuery(PLACES, ("resistance_filled",)),
    RouteQuery(PLACES),
    WayQuery(*PLACES),
    CoverageQuery(),
    LanesQuery(),
]


@pytest.mark.parametrize("query", TOO_MUCH)
def test_what_reads_too_much_known_ground_is_refused_before_it_is_read(answers, query, monkeypatch):
    monkeypatch.setattr("mapserver.query.views.MOST_BLOCKS", 3)
    monkeypatch.setattr("mapserver.query.block_layers.BlockLayers.blocks", None)
    monkeypatch.setattr("mapserver.past.past.StorePast.grid_as_of", None)
    with refused(Refusal.TOO_LARGE, "blocks .* of known ground, over 3: .*ask for"):
        answers.answer(query)


THEN_NS = NOW_NS + 10**11
TOO_MUCH_PAST = [
    RegionQuery(Bounds(-45, -45, 45, 45), ("visits",), as_of_ns=THEN_NS),
    RegionQuery(Bounds(-45, -45, 45, 45), ("visits",), minus_ns=THEN_NS),
    PointsQuery(PLACES, ("visits",), as_of_ns=THEN_NS),
    RouteQuery(PLACES, as_of_ns=THEN_NS),
    WorklistQuery(as_of_ns=THEN_NS),
    SegmentsQuery(as_of_ns=THEN_NS),
]


@pytest.mark.parametrize("query", TOO_MUCH_PAST)
def test_what_folds_too_much_evidence_of_the_past_at_once_is_refused_before(answers, query, monkeypatch):
    monkeypatch.setattr("mapserver.query.views.PAST_BYTES", 1000)
    monkeypatch.setattr("mapserver.past.past.StorePast.grid_as_of", None)
    with refused(Refusal.TOO_LARGE, "MB of evidence of the past at once, over 0: ask for"):
        answers.answer(query)


def test_a_cell_that_is_made_of_too_many_is_refused_with_what_is_not(answers, monkeypatch):
    monkeypatch.setattr("mapserver.query.region_pieces.READ_BYTES", 4 * 30**2)
    asked = {"resolution_m": 31.0}
    with refused(Refusal.TOO_LARGE, "at most 30 x 30; ask for fewer `layers`, or a finer `resolution`"):
        answers.region(RegionQuery(Bounds(-45, -45, 45, 45), ("visits",), **asked))
    first = answers.region(RegionQuery(Bounds(-45, -45, 45, 45), ("visits",), resolution_m=30.0))
    assert (first.piece.count, first["visits"].shape) == (9 + 7, (1, 1))


def test_places_that_lie_far_apart_are_read_as_others(answers, monkeypatch):
    query = PointsQuery((*PLACES, (18_000.0, -18_000.0)), ("grade_east", "grade_east_filled", "visits"))
    near = replace(query, places=PLACES)
    for fresh in (True, False):
        expected = answers.points(near)
        if fresh:
            answers._layers = BlockLayers(SITE.cell_m, CONFIG)
        got = answers.points(query)
        for name in query.layers:
            np.testing.assert_array_equal(got.layers[name][:2], expected.layers[name])
            assert np.isnan(got.layers[name][2])


UTM = (456100.5, 5427300.5)


@pytest.mark.parametrize(
    ("query", "name"),
    [
        (PointQuery(*UTM), "x`, `y"),
        (HistoryQuery(*UTM), "x`, `y"),
        (WhyQuery(0.0, -20_000.5), "x`, `y"),
        (PointsQuery(((1.0, 1.0), UTM)), "places"),
        (RegionQuery(Bounds(456_000, 5_427_000, 456_100, 5_427_100)), "bounds"),
        (RegionQuery((UTM, (456_200.0, 5_427_300.0), (456_200.0, 5_427_400.0))), "polygon"),
    ],
)
def test_numbers_of_another_frame_are_refused_with_where_the_map_lies(answers, query, name):
    where = r"the map lies at -?\d+\.\.\d+, -?\d+\.\.\d+ m; are these UTM or degrees\?"
    with pytest.raises(QueryError, match=f"parameter `{name}`: .* is off the site.*: {where}") as caught:
        answers.answer(query)
    assert caught.value.reason == Refusal.OUTSIDE_SITE


def driven(
    cell_m: float, half: int, changed: tuple[int, int, int, int], step: int = 1, c_rr: float = 0.2
) -> list[np.ndarray]:
    """Three hourly passes over a square of cells, a part (west, south, east, north) repaved before the last.

    half: half the edge; step: cells between samples, above 1 with gaps. c_rr: new ground; at the old one's 0.04 only
    the gradient differs.
    """
    places = np.arange(-half, half, step) + 0.5
    x, y = (axis.ravel() for axis in np.meshgrid(places, places))
    west, south, east, north = changed
    passes = []
    for hour in range(3):
        new = (hour == 2) & (x > west) & (x < east) & (y > south) & (y < north)
        stamps = NOW_NS + hour * 3600 * 10**9 + np.arange(x.size) * 240 * 10**9 // x.size
        place = {"x_m": x * cell_m, "y_m": y * cell_m, "stamp_ns": stamps, "cov_xx_m2": 0, "cov_yy_m2": 0}
        passes.append(samples(x.size, **place, c_rr=np.where(new, c_rr, 0.04), grade_e=np.where(new, -0.3, 0.1)))
    return passes


def map_of(folder, rows: list[np.ndarray], site=SITE, config=CONFIG) -> tuple[Writer, Answers]:
    """Map of passes folded past the door, which limits batches."""
    writer = open_writer(folder, config, site)

    def fold(store: Store) -> None:
        for part in rows:
            store.grid.fold(part, "a")
        store._newest = {"a": store.grid.newest_ns}

    writer.run(fold)
    return writer, answers_of(writer)


CHANGED = ("resistance", "weight", "changed_s", "visits", "age_s")
FILLED = ("resistance_filled", "resistance_class_filled", "resistance")


def assert_parts_are_cut_from_the_whole(answers: Answers, cell_m: float, half: int, names, seed: int) -> np.ndarray:
    """Compare random windows with the same cells of one whole window."""
    whole = region(answers, *(np.array([-half, -half, half, half]) * cell_m), names=names)
    draw = np.random.default_rng(seed)
    for _ in range(15):
        west, south = draw.integers(-half, half - 1, 2)
        east, north = (min(half, int(low + draw.integers(1, 30))) for low in (west, south))
        part = region(answers, *(np.array([west, south, east, north]) * cell_m), names=names)
        for name in names:
            expected = whole[name][south + half : north + half, west + half : east + half]
            assert np.array_equal(part[name], expected, equal_nan=True), (name, west, south, east, north)
    return whole


# The repaved area spans four blocks, then lies along a block's border.
@pytest.mark.parametrize("changed", [(-8, -7, 6, 9), (-23, -5, -16, 1)])
def test_a_change_across_blocks_is_answered_alike_in_every_window(tmp_path, changed):
    writer, answers = map_of(tmp_path, driven(1.0, 40, changed))
    whole = assert_parts_are_cut_from_the_whole(answers, 1.0, 48, CHANGED, seed=1)
    west, south, east, north = (edge + 48 for edge in changed)
    inside = np.zeros((96, 96), np.bool_)
    inside[south + 1 : north - 1, west + 1 : east - 1] = True
    assert np.allclose(whole["resistance"][inside], 0.2, rtol=0.05)
    assert np.isfinite(whole["changed_s"][inside]).all()
    assert np.isnan(whole["changed_s"]).sum() > 0.8 * 96 * 96
    for x, y in zip(np.arange(changed[0], changed[2]), np.arange(changed[1], changed[3]), strict=False):
        values = answers.point(PointQuery(x + 0.5, y + 0.5, CHANGED)).values
        for name in CHANGED:
            assert np.array_equal(np.float32(values[name]), whole[name][y + 48, x + 48], equal_nan=True)
    writer.close()


@pytest.mark.parametrize(("cell_m", "c_rr", "edge_m"), [(1.0, 0.04, 11.0), (0.5, 0.2, 6.0)])
def test_a_change_is_seen_with_all_its_surroundings_in_cells_of_any_size(tmp_path, cell_m, c_rr, edge_m):
    cells = round(edge_m / cell_m)  # a metre above the least
    rows = driven(cell_m, cells + 20, (-cells + 3, -4, 3, cells - 4), c_rr=c_rr)
    writer, answers = map_of(tmp_path, rows, replace(SITE, cell_m=cell_m))
    names = ("resistance", "grade_east", "changed_s")
    with closing(writer):
        whole = assert_parts_are_cut_from_the_whole(answers, cell_m, cells + 16, names, seed=2)
    assert np.isfinite(whole["changed_s"]).any()


def test_gaps_are_filled_alike_in_every_window(tmp_path):
    writer, answers = map_of(tmp_path, driven(1.0, 40, (-8, -7, 6, 9), step=3))
    whole = assert_parts_are_cut_from_the_whole(answers, 1.0, 48, FILLED, seed=3)
    writer.close()
    assert np.isfinite(whole["resistance_filled"]).sum() > 2 * np.isfinite(whole["resistance"]).sum()


def test_the_change_options_reach_the_answer(tmp_path):
    rows = driven(1.0, 20, (-6, -6, 6, 6))
    for detect in (True, False):
        config = replace(CONFIG, change=replace(CONFIG.change, detect=detect))
        writer, answers = map_of(tmp_path / str(detect), rows, config=config)
        changed_s = region(answers, -20, -20, 20, 20, names=("changed_s",))["changed_s"]
        writer.close()
        assert np.isfinite(changed_s).any() == detect
