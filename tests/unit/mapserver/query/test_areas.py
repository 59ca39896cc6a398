"""Regions: outlines, larger cells, pieces; many points."""

from contextlib import closing
from itertools import pairwise

import numpy as np
import pytest

from mapserver.layers.cell_layers import LAYERS
from mapserver.query import region_pieces
from mapserver.query.answering import WITHOUT_MEAN
from mapserver.query.areas import cells_to_a_side
from mapserver.query.region_pieces import PIECE_BYTES, OpenRegions, PieceGrid, RegionReading
from protocol.errors import QueryError, Refusal
from protocol.queries.answer_codec import decode_points, decode_region
from protocol.queries.requests import PieceQuery, PointQuery, PointsQuery, RegionQuery, parse_query
from protocol.site.geometry import BLOCK_CELLS, Bounds, CellWindow
from sitegrid.whole_answers import joined
from tests.unit.mapserver.data import NOW_NS, incoming, open_writer, random_samples, refused, send
from tests.unit.mapserver.query.fake_upkeep import answers_of

STAR = ((-30.0, -20.0), (0.0, -5.0), (30.0, -22.0), (12.0, 3.0), (28.0, 30.0), (0.5, 14.0), (-33.0, 25.0), (-10.0, 2.2))
NAMES = ("resistance", "grade_east_filled", "visits")


@pytest.fixture(scope="module")
def answers(tmp_path_factory):
    with closing(open_writer(tmp_path_factory.mktemp("store"))) as writer:
        early, late = random_samples(900, 3), random_samples(900, 4)
        late["stamp_ns"] += 10 * 3600 * 10**9
        send(writer, [incoming(early), incoming(late, machine="b")])
        yield answers_of(writer)


def ask(answers, query):
    """Through the bytes of query and answer, by piece."""
    first = decode_region(answers.answer(parse_query(query.name, query.parameters())))
    if not first.piece:
        return first
    more = (PieceQuery(first.piece.cursor, number) for number in range(1, first.piece.count))
    return joined([first, *(decode_region(answers.answer(piece)) for piece in more)])


def winding(x, y, outline) -> bool:
    """Whether the outline winds around a place."""
    corners = np.array([*outline, outline[0]]) - (x, y)
    angles = np.unwrap(np.arctan2(corners[:, 1], corners[:, 0]))
    return bool(abs(angles[-1] - angles[0]) > np.pi)


def test_an_outline_cuts_the_rectangle_around_it(answers):
    box = Bounds(-33.0, -22.0, 30.0, 30.0)
    for when in ({}, {"minus_ns": NOW_NS + 1800 * 10**9}):
        cut, whole = (ask(answers, RegionQuery(area, NAMES, **when)) for area in (STAR, box))
        within = np.array([[winding(x, y, STAR) for x in whole.x_m] for y in whole.y_m])
        assert (cut.x_m.tolist(), cut.y_m.tolist()) == (whole.x_m.tolist(), whole.y_m.tolist())
        for name in NAMES:
            expected = np.where(within, whole[name], np.nan)
            assert np.array_equal(cut[name], expected, equal_nan=True), name
            assert np.isfinite(cut[name]).any()


def test_larger_cells_have_the_mean_of_what_is_known(answers):
    count = 5
    large = ask(answers, RegionQuery(Bounds(-41.0, -30.0, 39.0, 37.0), NAMES, resolution_m=5.0))
    assert large.cell_m == count
    assert large.bounds.west_m % count == large.bounds.south_m % count == 0
    assert large.bounds.west_m <= -41.0 < large.bounds.west_m + count
    fine = ask(answers, RegionQuery(large.bounds, NAMES))
    for name in NAMES:
        for row in range(0, len(large.y_m), 3):
            for column in range(0, len(large.x_m), 3):
                cells = fine[name][row * count : (row + 1) * count, column * count : (column + 1) * count]
                known = cells[np.isfinite(cells)].astype(float)
                expected = known.mean() if known.size else np.nan
                assert large[name][row, column] == pytest.approx(expected, rel=1e-6, nan_ok=True)


def test_large_outlines_come_in_pieces_that_are_one_region(answers, monkeypatch):
    query = RegionQuery(STAR, NAMES, resolution_m=2.0)
    at_once = ask(answers, query)
    monkeypatch.setattr("mapserver.query.region_pieces.PIECE_BYTES", 16 * 16 * len(NAMES) * 4)
    first = decode_region(answers.answer(query))
    assert first.piece
    assert first.piece.count > 3
    pieces = ask(answers, query)
    for name in NAMES:
        assert np.array_equal(pieces[name], at_once[name], equal_nan=True)


def test_what_has_no_mean_is_omitted_or_refused(answers):
    box = Bounds(0.0, 0.0, 20.0, 20.0)
    assert tuple(ask(answers, RegionQuery(box, resolution_m=2.0)).layers) == tuple(
        name for name in LAYERS if name not in WITHOUT_MEAN
    )
    with pytest.raises(QueryError, match="layer `heading` has no mean; ask for it without `resolution`"):
        answers.region(RegionQuery(box, ("heading",), resolution_m=2.0))


@pytest.mark.parametrize("resolution_m", [2.5, 0.5])
def test_a_resolution_is_a_multiple_of_the_cell(answers, resolution_m):
    with refused(Refusal.OUT_OF_RANGE, r"parameter `resolution`: .* is no multiple of the cell's 1 m"):
        answers.region(RegionQuery(Bounds(0.0, 0.0, 20.0, 20.0), resolution_m=resolution_m))
    assert cells_to_a_side(0.3, 0.1) == 3


@pytest.mark.parametrize("when", [{}, {"minus_ns": NOW_NS + 1800 * 10**9}])
def test_points_are_what_each_point_is(answers, when):
    draw = np.random.default_rng(8)
    places = [*draw.uniform(-70, 70, (8, 2)).tolist(), [-1.0, -16.0], [2e4, -2e4], [-1.0, -16.0]]
    names = ("resistance", "resistance_filled", "age_s", "visits")
    query = PointsQuery(tuple(map(tuple, places)), names, **when)
    many = decode_points(answers.answer(parse_query("points", query.parameters())))
    known = 0
    for i, (x, y) in enumerate(places):
        one = answers.point(PointQuery(x, y, names, **when))
        assert (many.x_m[i], many.y_m[i]) == (one.x_m, one.y_m)
        for name in names:
            assert many[name][i] == pytest.approx(one.values[name], nan_ok=True, abs=0)
            known += np.isfinite(many[name][i])
        assert (many.version, many.stamp_ns) == (one.version, one.stamp_ns)
    assert known > 5


def test_pieces_are_of_one_version_while_samples_come_in(tmp_path, monkeypatch):
    rows, more = random_samples(3000, 8, std_m=1.0), random_samples(3000, 9, std_m=1.0)
    names = ("resistance", "visits", "resistance_filled", "grade_filled_std")
    with closing(open_writer(tmp_path)) as writer:
        send(writer, [incoming(rows)])
        answers, query = answers_of(writer), RegionQuery(Bounds(-93.5, -100, 61, 100), names)
        before = answers.region(query)
        monkeypatch.setattr(region_pieces, "PIECE_BYTES", 2**15)
        first = answers.region(query)
        send(writer, [incoming(more, len(rows) + 1)])
        others = [answers.piece(PieceQuery(first.piece.cursor, n)) for n in range(1, first.piece.count)]
        now, then = ask(answers, query), joined([first, *others])
    assert (then.x_m.tolist(), then.y_m.tolist()) == (before.x_m.tolist(), before.y_m.tolist())
    for name in names:
        assert np.array_equal(then[name], before[name], equal_nan=True)
        assert not np.array_equal(now[name], before[name], equal_nan=True)


@pytest.mark.parametrize("layers", [1, 13])
def test_pieces_cover_every_cell_once_and_stay_small(layers):
    rng = np.random.default_rng(5)
    for limits in [(1000, 1000), (40, 3000), (3000, 40), (100_000, 2), (2, 100_000), (20, 20)]:
        sizes = rng.integers(1, limits)
        window = CellWindow(*(int(v) for v in (*rng.integers(-5000, 5000, 2), *sizes)))
        grid = PieceGrid.of_layers(window, layers)
        whole = [grid.piece(number) for number in range(grid.count)]
        assert sum(piece.columns * piece.rows for piece in whole) == window.columns * window.rows
        assert max(piece.columns * piece.rows for piece in whole) * 4 * layers <= PIECE_BYTES, window
        columns = sorted({(piece.column, piece.column + piece.columns) for piece in whole})
        rows = sorted({(piece.row, piece.row + piece.rows) for piece in whole})
        assert len(columns) * len(rows) == grid.count
        for spans, first, count in ((columns, window.column, window.columns), (rows, window.row, window.rows)):
            assert (spans[0][0], spans[-1][1]) == (first, first + count)
            assert all(end == begin and end % BLOCK_CELLS == 0 for (_, end), (begin, _) in pairwise(spans))


LARGE = RegionReading(CellWindow(0, 0, 4000, 4000), ("visits",), ())


@pytest.fixture
def clock(monkeypatch):
    now_s = [100.0]
    monkeypatch.setattr(region_pieces.time, "monotonic", lambda: now_s[0])
    return now_s


def test_a_region_expires_that_nobody_reads_on_or_that_is_read_for_too_long(clock):
    regions = OpenRegions()
    cursor = regions.open(LARGE)
    for _ in range(4):
        clock[0] += region_pieces.IDLE_S - 1
        assert regions.reading(cursor, 1)[0] is LARGE
    with refused(Refusal.OUT_OF_RANGE, "from 0"):
        regions.reading(cursor, 10_000)
    clock[0] += region_pieces.IDLE_S + 1
    with refused(Refusal.EXPIRED, "ask for it again"):
        regions.reading(cursor, 1)
    cursor, opened_s = regions.open(LARGE), clock[0]
    while clock[0] < opened_s + region_pieces.OPEN_S:
        assert regions.reading(cursor, 1)[0] is LARGE
        clock[0] += region_pieces.IDLE_S / 2
    clock[0] += 1
    with refused(Refusal.EXPIRED):
        regions.reading(cursor, 1)


def test_so_many_regions_are_read_at_once_and_one_that_is_read_makes_room(clock):
    regions = OpenRegions()
    cursors = [regions.open(LARGE) for _ in range(region_pieces.MOST_OPEN)]
    with pytest.raises(QueryError) as caught:
        regions.open(LARGE)
    assert caught.value.reason == Refusal.OVERLOADED
    assert caught.value.retry_after_s > 0
    _, grid = regions.reading(cursors[3], 0)
    regions.reading(cursors[3], grid.count - 1)
    regions.reading(cursors[3], grid.count - 1)  # once more: it may have been lost
    regions.open(LARGE)
    with pytest.raises(QueryError):
        regions.reading(cursors[3], 0)
    assert regions.reading(cursors[0], 0)[0] is LARGE
    clock[0] += region_pieces.IDLE_S + 1
    assert len({regions.open(LARGE) for _ in range(region_pieces.MOST_OPEN)}) == region_pieces.MOST_OPEN
