import numpy as np
import pytest
from mapserver_data import NOW_NS, folded, random_samples, same, samples

from mapserver import evidence as ev
from mapserver.grid import READ_BLOCKS, Grid, chunks
from mapserver.votes import FoldConfig
from protocol.geometry import CellWindow

EVERYTHING = CellWindow(-(2**20), -(2**20), 2**21, 2**21)


def test_an_empty_grid_knows_nothing():
    grid = Grid(1.0, FoldConfig())
    assert grid.bounds() is None
    assert grid.known_cells() == 0
    assert grid.blocks_in(EVERYTHING) == []
    assert grid.evidence([(0, 0)]).counts.sum() == 0
    grid.fold(samples(0), "a")
    assert len(grid.state().codes) == 0


def test_blocks_exist_only_where_somebody_drove():
    grid = folded(samples(3, x_m=[8.0, 1000.0, -900.0], y_m=[8.0, 8.0, -5000.0]))
    assert grid.blocks_in(EVERYTHING) == [(-57, -313), (0, 0), (62, 0)]


def test_a_sample_at_a_corner_touches_four_blocks():
    grid = folded(samples(x_m=0.0, y_m=0.0, cov_xx_m2=0.25, cov_yy_m2=0.25))
    assert grid.blocks_in(EVERYTHING) == [(-1, -1), (-1, 0), (0, -1), (0, 0)]
    weights = grid.evidence(grid.blocks_in(EVERYTHING)).counts[..., ev.WEIGHT].sum(axis=1)
    assert weights.max() - weights.min() < 0.01 * weights.sum()


@pytest.mark.parametrize(
    ("window", "expected"),
    [
        (CellWindow(0, 0, 1, 1), [(0, 0)]),
        (CellWindow(15, 15, 1, 1), [(0, 0)]),
        (CellWindow(16, 0, 10, 10), []),
        (CellWindow(-1, -1, 1, 1), []),
        (CellWindow(-17, 0, 18, 1), [(-2, 0), (0, 0)]),
    ],
)
def test_window_finds_the_blocks_that_it_touches(window, expected):
    grid = folded(samples(2, x_m=[8.0, -24.0], y_m=[8.0, 8.0]))
    assert grid.blocks_in(window) == expected


def test_bounds_are_those_of_the_blocks():
    grid = folded(samples(2, x_m=[8.0, -24.0], y_m=[8.0, 40.0]))
    assert grid.bounds() == (-32, 0, 16, 48)


def test_known_cells_are_counted_once_over_all_buckets():
    once = folded(samples(1))
    again = folded(samples(2, stamp_ns=[NOW_NS, NOW_NS + 3600 * 10**9]))
    assert len(again.state().codes) == 2
    assert once.known_cells() == again.known_cells() > 0


def test_evidence_is_summed_over_buckets():
    stamps = NOW_NS + np.array([0, 3600, 7200]) * 10**9
    grid = folded(samples(3, stamp_ns=stamps, distance_m=[1.0, 2.0, 4.0]))
    evidence = grid.evidence([(0, 0)])
    assert evidence.counts[..., ev.WEIGHT].sum() == 7 * ev.WEIGHT_UNITS_PER_M
    assert evidence.newest_ns.max() == stamps[2]
    assert np.bitwise_count(evidence.bitmaps[..., ev.VISITS]).max() == 3


def test_evidence_comes_in_the_order_asked_for_as_a_copy():
    grid = folded(samples(2, x_m=[8.0, 24.0], distance_m=[1.0, 2.0]))
    evidence = grid.evidence([(1, 0), (5, 5), (0, 0)])
    assert evidence.counts[..., ev.WEIGHT].sum(axis=1).tolist() == [2 * 4096, 0, 4096]
    before = grid.state()
    evidence.counts[:] = 0
    evidence.bitmaps[:] = 0
    assert np.array_equal(grid.state().counts, before.counts)


def test_summing_buckets_does_not_wrap():
    grid = folded(samples(4, stamp_ns=NOW_NS + np.arange(4) * 3600 * 10**9))
    grid._counts[grid._counts > 0] = ev.COUNT_MAX
    assert grid.evidence([(0, 0)]).counts.max() == 4 * int(ev.COUNT_MAX)


@pytest.mark.parametrize("seed", [1, 2])
def test_a_grid_from_its_state_folds_on_as_if_nothing_happened(seed):
    rows = random_samples(400, seed)
    whole = folded(rows)
    first = folded(rows[:200])
    again = Grid.from_state(1.0, FoldConfig(), first.state())
    assert same(first, again)
    again.fold(rows[200:], "a")
    assert same(again, whole)


def test_state_is_a_copy():
    grid = folded(samples(1))
    state = grid.state()
    before = state.counts.copy()
    grid.fold(samples(5), "a")
    assert np.array_equal(state.counts, before)


def test_many_blocks_keep_their_evidence_while_room_is_made():
    x = np.arange(-50, 50) * 40.0
    grid = Grid(1.0, FoldConfig())
    for i in range(len(x)):
        grid.fold(samples(1, x_m=x[i], distance_m=1 + i % 7), "a")
    assert same(grid, folded(samples(100, x_m=x, distance_m=1 + np.arange(100) % 7, stamp_ns=NOW_NS)))


@pytest.mark.parametrize("cell_m", [0.05, 1.0, 100.0])
@pytest.mark.parametrize("stamp_ns", [1, NOW_NS, 4_102_444_800_000_000_000])
def test_the_ends_of_the_site_and_of_time_have_blocks_of_their_own(cell_m, stamp_ns):
    corners = np.array([-100_000.0, 100_000.0])
    x, y = (axis.ravel() for axis in np.meshgrid(corners, corners))
    rows = samples(4, x_m=x, y_m=y, stamp_ns=stamp_ns, cov_xx_m2=0, cov_yy_m2=0)
    grid = folded(rows, cell_m=cell_m, bucket_s=60.0)
    for position in zip(x, y, strict=True):
        column, row = (int(np.floor(p / cell_m)) for p in position)
        near = grid.blocks_in(CellWindow(column - 20, row - 20, 40, 40))
        assert grid.evidence(near).counts[..., ev.WEIGHT].sum() == 4096
    assert (grid.state().codes > 0).all()
    assert set(grid.state().codes >> 36) == {stamp_ns // (60 * 10**9)}


def test_chunks_hold_every_block_once():
    blocks = [(i, -i) for i in range(2 * READ_BLOCKS + 3)]
    pieces = list(chunks(blocks))
    assert [len(piece) for piece in pieces] == [READ_BLOCKS, READ_BLOCKS, 3]
    assert [block for piece in pieces for block in piece] == blocks
