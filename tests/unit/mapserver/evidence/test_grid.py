import numpy as np
import pytest

from mapserver.evidence import cells as ev
from mapserver.evidence.fold_config import FoldConfig, is_foldable
from mapserver.evidence.grid import Grid
from mapserver.evidence.grid_state import GridCounts
from mapserver.evidence.pages import Pages
from protocol.site.geometry import CellWindow
from tests.unit.mapserver.data import NOW_NS, filled_to, folded, random_samples, same, samples


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


def test_counts_are_kept_while_folding_and_fold_nothing(monkeypatch):
    """Through folds, merges and snapshots; waiting samples count at once, their cells and bounds once folded."""
    grid, parts = Grid(1.0, FoldConfig(), 200), [random_samples(90, seed, std_m=4.0) for seed in range(5)]
    for part in parts[:4]:
        grid.fold(part, "a")
        with monkeypatch.context() as patched:
            patched.setattr(Grid, "_drain", lambda _: pytest.fail("folds"))
            counts = grid.counts()
        sure = is_foldable(part, grid.config)
        assert 0 < sure.sum() < len(part)
        assert (counts.cells, counts.bounds) != (grid.known_cells(), grid.bounds())
        assert (counts.folded, counts.skipped) == (grid.folded, grid.skipped)
    again = Grid.from_state(1.0, grid.config, grid.state())
    grid.merge(folded(parts[4]))
    for each, rows in ((again, parts[:4]), (grid, parts)):
        timelines = each._timelines
        xs, ys = zip(*timelines, strict=True)
        bounds = (16 * min(xs), 16 * min(ys), 16 * max(xs) + 16, 16 * max(ys) + 16)
        cells = sum(timeline.known.bit_count() for timeline in timelines.values())
        sure = sum(int(is_foldable(part, grid.config).sum()) for part in rows)
        assert each.counts() == GridCounts(sure, 90 * len(rows) - sure, cells, bounds)


def test_evidence_is_summed_over_buckets():
    stamps = NOW_NS + np.array([0, 3600, 7200]) * 10**9
    grid = folded(samples(3, stamp_ns=stamps, distance_m=[1.0, 2.0, 4.0]))
    evidence = grid.evidence([(0, 0)])
    assert evidence.weight.sum() == 7 * ev.WEIGHT_UNITS_PER_M
    assert evidence.newest_ns.max() == stamps[2]
    assert np.bitwise_count(evidence.bitmaps[..., ev.VISITS]).max() == 3


def test_evidence_comes_in_the_order_asked_for_as_a_copy():
    grid = folded(samples(2, x_m=[8.0, 24.0], distance_m=[1.0, 2.0]))
    evidence = grid.evidence([(1, 0), (5, 5), (0, 0)])
    assert evidence.weight.sum(axis=1).tolist() == [2 * 4096, 0, 4096]
    assert evidence.counts.shape == (3, 256, ev.COUNTS)
    assert evidence.bitmaps.shape == (3, 256, 2)
    assert evidence.newest_ns.shape == evidence.changed_ns.shape == (3, 256)
    assert not evidence.changed_ns.any()
    assert grid.evidence([]).counts.shape == (0, 256, ev.COUNTS)
    evidence.counts[:] = 0
    evidence.bitmaps[:] = 0
    assert same(grid, folded(samples(2, x_m=[8.0, 24.0], distance_m=[1.0, 2.0])))


def test_summing_buckets_does_not_wrap():
    grid = folded(samples(4, stamp_ns=NOW_NS + np.arange(4) * 3600 * 10**9))
    grid = Grid.from_state(1.0, FoldConfig(), filled_to(grid.state(), ev.COUNT_MAX))
    assert grid.evidence([(0, 0)]).counts.max() == 4 * int(ev.COUNT_MAX)


def test_state_is_a_copy():
    grid = folded(samples(1))
    state = grid.state()
    before = [(at.page.votes.copy(), at.page.cells.copy()) for at in state.pages]
    grid.fold(samples(5), "a")
    assert grid.known_cells()
    for at, (votes, cells) in zip(state.pages, before, strict=True):
        assert np.array_equal(at.page.votes, votes)
        assert np.array_equal(at.page.cells, cells)


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
        assert grid.evidence(near).weight.sum() == 4096
    assert {(at.tier, at.index) for at in grid.state().pages} == {(0, stamp_ns // (60 * 10**9))}


@pytest.mark.parametrize(("limit", "most"), [("MOST_PAGES", 3), ("MOST_VOTES", 1)])
def test_pages_are_packed_a_few_at_a_time_where_space_is_short(limit, most, monkeypatch):
    rows = random_samples(200, 4)
    whole = folded(rows)
    monkeypatch.setattr(f"mapserver.evidence.fold.{limit}", most)
    assert same(folded(rows), whole)


def test_pages_of_a_block_come_in_the_order_of_time():
    stamps = NOW_NS + np.arange(0, 12 * 24, 2) * 1800 * 10**9
    draw = np.random.default_rng(1)
    grid = folded(samples(len(stamps), stamp_ns=stamps[draw.permutation(len(stamps))], cov_xx_m2=0, cov_yy_m2=0))
    pages, nothing = grid.pages([(0, 0), (9, 9)])
    newest = [int(timed.page.cells["newest_ns"].max()) for timed in pages]
    assert newest == sorted(newest)
    assert not len(nothing)
    assert all(timed.first_ns <= stamp < timed.end_ns for timed, stamp in zip(pages, newest, strict=True))


def test_blocks_are_touched_once_until_they_are_folded_into_again():
    grid = folded(samples(2, x_m=[8.0, 40.0]))
    assert sorted(grid.take_touched(9)) == [(0, 0), (2, 0)]
    assert grid.take_touched(9) == []
    grid.fold(samples(1), "b")
    grid.fold(samples(1), "a")
    assert grid.take_touched(9) == [(0, 0)]
    grid.touch_all()
    assert len(grid.take_touched(1)) == len(grid.take_touched(1)) == 1
    assert grid.take_touched(1) == []


def test_a_cell_and_bucket_that_machines_drive_take_few_bytes():
    """A page takes about 45 bytes; this guards it."""
    draw, n = np.random.default_rng(0), 4000
    turn = np.cumsum(draw.normal(0, 0.02, n))
    rows = samples(
        n,
        x_m=np.cumsum(0.5 * np.cos(turn)),
        y_m=np.cumsum(0.5 * np.sin(turn)),
        heading_rad=(turn + np.pi) % (2 * np.pi) - np.pi,
        distance_m=0.5,
        stamp_ns=NOW_NS + np.arange(n) * 250_000_000,
        cov_xx_m2=1.2**2,
        cov_yy_m2=1.2**2,
        c_rr=0.04 * np.exp(draw.normal(0, 0.15, n)),
        grade_e=draw.normal(0.03, 0.02, n),
        grade_n=draw.normal(-0.02, 0.02, n),
    )
    blocks = [record for _, _, record in folded(rows, keep_buckets=1000).state().blocks]
    assert sum(map(len, blocks)) / sum(len(Pages.unpacked(record).cells) for record in blocks) <= 55
