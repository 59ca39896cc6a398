"""Which cells lie in an outline, and what larger cells know."""

from contextlib import closing

import numpy as np
import pytest

from mapserver.layers.cell_layers import LAYERS
from mapserver.query.answering import WITHOUT_MEAN
from mapserver.query.areas import cells_to_a_side
from protocol.errors import QueryError, Refusal
from protocol.queries.answer_codec import decode_points, decode_region
from protocol.queries.pieces import joined
from protocol.queries.requests import PieceQuery, PointQuery, PointsQuery, RegionQuery, When, encode_query, parse_query
from protocol.site.geometry import Bounds
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
    """Through the bytes of question and answer, piece by piece."""
    first = decode_region(answers.answer(parse_query(query.name, encode_query(query))))
    if not first.piece:
        return first
    more = (PieceQuery(first.piece.cursor, number) for number in range(1, first.piece.count))
    return joined([first, *(decode_region(answers.answer(piece)) for piece in more)])


def winding(x, y, outline) -> bool:
    """Whether an outline turns around a place."""
    corners = np.array([*outline, outline[0]]) - (x, y)
    angles = np.unwrap(np.arctan2(corners[:, 1], corners[:, 0]))
    return bool(abs(angles[-1] - angles[0]) > np.pi)


def test_an_outline_cuts_the_rectangle_around_it(answers):
    box = Bounds(-33.0, -22.0, 30.0, 30.0)
    for when in (When(), When(minus_ns=NOW_NS + 1800 * 10**9)):
        cut, whole = (ask(answers, RegionQuery(area, NAMES, when=when)) for area in (STAR, box))
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


@pytest.mark.parametrize("when", [When(), When(as_of_ns=NOW_NS + 900 * 10**9), When(minus_ns=NOW_NS + 1800 * 10**9)])
def test_points_are_what_each_point_is(answers, when):
    draw = np.random.default_rng(8)
    places = [*draw.uniform(-70, 70, (20, 2)).tolist(), [-1.0, -16.0], [1e5, -1e5], [-1.0, -16.0]]
    names = ("resistance", "resistance_filled", "age_s", "visits")
    query = PointsQuery(tuple(map(tuple, places)), names, when=when)
    many = decode_points(answers.answer(parse_query("points", encode_query(query))))
    known = 0
    for i, (x, y) in enumerate(places):
        one = answers.point(PointQuery(x, y, names, when=when))
        assert (many.x_m[i], many.y_m[i]) == (one.x_m, one.y_m)
        for name in names:
            assert many[name][i] == pytest.approx(one.values[name], nan_ok=True, abs=0)
            known += np.isfinite(many[name][i])
        assert (many.version, many.stamp_ns) == (one.version, one.stamp_ns)
    assert known > 15
