"""Regions in pieces: the same values as in one piece, all of one version of the map."""

from contextlib import closing
from itertools import pairwise

import numpy as np
import pytest

from mapserver.query import region_pieces
from mapserver.query.answering import Answers
from mapserver.query.region_pieces import PIECE_BYTES, OpenRegions, PieceGrid, Reading
from protocol.errors import QueryError, Refusal
from protocol.queries.answer_codec import decode_region, encode_region
from protocol.queries.answers import Region
from protocol.queries.pieces import joined
from protocol.queries.requests import PieceQuery, RegionQuery
from protocol.site.geometry import BLOCK_CELLS, Bounds, CellWindow
from tests.unit.mapserver.data import incoming, open_writer, random_samples, refused, send
from tests.unit.mapserver.query.fake_upkeep import answers_of

NAMES = ("resistance", "visits", "resistance_filled", "grade_filled_std")
ROWS = random_samples(3000, 8, std_m=1.0)


@pytest.fixture
def served(tmp_path):
    with closing(open_writer(tmp_path)) as writer:
        send(writer, [incoming(ROWS)])
        yield writer, answers_of(writer)


def read(answers: Answers, query: RegionQuery) -> list[Region]:
    """All pieces, as they travel."""
    first = answers.region(query)
    numbers = range(1, first.piece.count) if first.piece else ()
    others = [answers.piece(PieceQuery(first.piece.cursor, number)) for number in numbers]
    return [decode_region(encode_region(piece)) for piece in (first, *others)]


def same(a: Region, b: Region) -> bool:
    layers = all(np.array_equal(a[name], b[name], equal_nan=True) for name in a.layers)
    return list(a.layers) == list(b.layers) and np.allclose(a.x_m, b.x_m) and np.allclose(a.y_m, b.y_m) and layers


def test_pieces_are_of_one_version_while_samples_come_in(served, monkeypatch):
    writer, answers = served
    query = RegionQuery(Bounds(-100, -100, 100, 100), NAMES)
    before = answers.region(query)
    monkeypatch.setattr(region_pieces, "PIECE_BYTES", 2**15)
    first = answers.region(query)
    send(writer, [incoming(random_samples(3000, 9, std_m=1.0), len(ROWS) + 1)])
    others = [answers.piece(PieceQuery(first.piece.cursor, n)) for n in range(1, first.piece.count)]
    assert same(joined([first, *others]), before)
    assert not same(joined(read(answers, query)), before)
    repeated = answers.piece(PieceQuery(first.piece.cursor, 1))
    assert same(repeated, others[0])


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


LARGE = Reading(CellWindow(0, 0, 4000, 4000), ("visits",), ())


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
    regions.reading(cursors[3], grid.count - 1)  # once more: it may have got lost
    regions.open(LARGE)
    with pytest.raises(QueryError):
        regions.reading(cursors[3], 0)
    assert regions.reading(cursors[0], 0)[0] is LARGE
    clock[0] += region_pieces.IDLE_S + 1
    assert len({regions.open(LARGE) for _ in range(region_pieces.MOST_OPEN)}) == region_pieces.MOST_OPEN
