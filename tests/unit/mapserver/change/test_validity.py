import json
from dataclasses import asdict, replace

import numpy as np
import pytest

from mapserver.change.change_log import ChangeLog
from mapserver.change.detection import ChangeConfig, reach_blocks
from mapserver.change.validity import around, valid_pages
from mapserver.evidence import cells as ev
from mapserver.evidence.fold_config import FoldConfig
from mapserver.evidence.grid import Grid
from mapserver.evidence.timeline import evidence
from mapserver.layers import cell_layers
from mapserver.layers.cell_layers import ReadConfig
from protocol.queries.answers import GroundChange
from tests.unit.mapserver.data import NOW_NS, samples

HOUR_NS = 3600 * 10**9
CONFIG = ChangeConfig()
OLD, NEW = 0.04, 0.2
PASSES = 4  # the last finds repaved ground


def lane(hour: int, west: float, south: float, wide: int, high: int, **ground: float):
    """A sample per cell centre of an area, within four minutes."""
    x, y = (axis.ravel() + 0.5 for axis in np.meshgrid(west + np.arange(wide), south + np.arange(high)))
    stamps = NOW_NS + hour * HOUR_NS + np.arange(x.size) * 240 * 10**9 // x.size
    return samples(x.size, x_m=x, y_m=y, stamp_ns=stamps, cov_xx_m2=0.04, cov_yy_m2=0.04, **ground)


def repaved(west: float, south: float, size: int, **options: int) -> Grid:
    """64 x 64 cells around the origin, driven hourly; an area is repaved before the last pass."""
    grid = Grid(1.0, FoldConfig(**options))
    for hour in range(PASSES):
        rows = lane(hour, -32, -32, 64, 64, c_rr=OLD)
        inside = (np.abs(rows["x_m"] - west - size / 2) < size / 2) & (
            np.abs(rows["y_m"] - south - size / 2) < size / 2
        )
        rows["c_rr"][inside & (hour == PASSES - 1)] = NEW
        grid.fold(rows, "a")
    return grid


def read(grid: Grid, config: ChangeConfig = CONFIG) -> ev.Evidence:
    blocks = [(x, y) for y in range(-2, 2) for x in range(-2, 2)]
    pages = dict(zip(blocks, grid.pages(blocks), strict=True))
    first = valid_pages(pages, grid.cell_m, config)
    sums = evidence([pages[block] for block in blocks], [first[block] for block in blocks])

    def image(values: np.ndarray) -> np.ndarray:
        tiles = values.reshape(4, 4, 16, 16, *values.shape[2:])
        return np.moveaxis(tiles, 2, 1).reshape(64, 64, *values.shape[2:])

    return ev.Evidence(*(image(getattr(sums, f)) for f in ("counts", "bitmaps", "newest_ns", "changed_ns")))


def resistance(now: ev.Evidence) -> np.ndarray:
    return cell_layers.read(now, ["resistance"], ReadConfig())["resistance"]


def area(west: int, south: int, size: int, margin: int = 0) -> np.ndarray:
    image = np.zeros((64, 64), np.bool_)
    image[
        south + 32 - margin : south + size + 32 + margin,
        west + 32 - margin : west + size + 32 + margin,
    ] = True
    return image


@pytest.mark.parametrize("place", [(-12, -12), (3, 3), (-5, 4), (12, -20), (-30, -30)])
def test_a_repaved_area_is_seen_after_one_pass_and_the_rest_stays(place):
    now = read(repaved(*place, 10))
    value = resistance(now)
    inside, outside = area(*place, 10, -1), ~area(*place, 10, 1)
    assert np.allclose(value[inside], NEW, rtol=0.05)
    assert np.allclose(value[outside], OLD, rtol=0.05)
    assert not now.changed_ns[outside].any()
    assert now.weight[inside].max() < 2 * ev.WEIGHT_UNITS_PER_M  # one pass
    assert now.weight[outside].min() > (PASSES - 2) * ev.WEIGHT_UNITS_PER_M  # all passes


@pytest.mark.parametrize("keep_buckets", [1, 2, 3])
def test_a_change_is_dated_also_where_old_passes_are_summed(keep_buckets):
    now, inside = read(repaved(-5, 4, 10, keep_buckets=keep_buckets)), area(-5, 4, 10, -1)
    assert np.allclose(resistance(now)[inside], NEW, rtol=0.05)
    assert (now.changed_ns[inside] >= NOW_NS + (PASSES - 2) * HOUR_NS).all()
    assert (now.changed_ns[inside] <= NOW_NS + (PASSES - 1) * HOUR_NS).all()


def test_a_change_is_dated_after_the_last_old_sample_of_the_same_span():
    """Old and new evidence within an hour, which begins before the old sample."""
    grid = Grid(1.0, FoldConfig(keep_buckets=1))
    stamps = [NOW_NS, NOW_NS + 300 * 10**9, NOW_NS + 1200 * 10**9]
    for stamp_ns, c_rr in zip(stamps, (OLD, OLD, NEW), strict=True):
        rows = lane(0, 0, 0, 16, 16, c_rr=c_rr)
        rows["stamp_ns"] = stamp_ns
        grid.fold(rows, "a")
    pages = {(0, 0): grid.pages([(0, 0)])[0]}
    valid = evidence([pages[0, 0]], [valid_pages(pages, 1.0, CONFIG)[0, 0]])
    inside = np.zeros((16, 16), np.bool_)
    inside[2:-2, 2:-2] = True
    changed = valid.changed_ns[0][inside.ravel()]
    assert (changed >= stamps[1]).all()
    assert (changed <= stamps[2]).all()


@pytest.mark.parametrize(("size_m", "seen"), [(7.0, True), (13.0, False)])
def test_the_least_size_is_obeyed(size_m, seen):
    now = read(repaved(3, 3, 10), replace(CONFIG, size_m=size_m))
    assert now.changed_ns.any() == seen


def test_of_two_changes_the_last_counts_and_dates():
    grid = Grid(1.0, FoldConfig())
    for hour, c_rr in enumerate([OLD, OLD, NEW, NEW, 0.01]):
        grid.fold(lane(hour, -16, -16, 32, 32, c_rr=c_rr), "a")
    now = read(grid)
    inside = area(-16, -16, 32, -2)
    assert np.allclose(resistance(now)[inside], 0.01, rtol=0.1)
    assert (now.changed_ns[inside] >= NOW_NS + 3 * HOUR_NS).all()
    assert (now.changed_ns[inside] <= NOW_NS + 4 * HOUR_NS).all()


@pytest.mark.parametrize("days", [0, 1])
def test_a_change_stays_found_where_the_rest_of_its_block_is_driven_on(days):
    grid = Grid(1.0, FoldConfig())
    for hour, c_rr in [(0, OLD), (1, OLD), (2, OLD), (5, NEW)]:
        grid.fold(lane(hour, 0, 0, 10, 10, c_rr=c_rr), "a")
    for day in range(days + 1):
        for hour in range(6, 13):
            grid.fold(lane(24 * day + hour, 0, 12, 16, 2, c_rr=0.06), "b")
    assert np.allclose(resistance(read(grid))[area(1, 1, 8)], NEW, rtol=0.05)


def test_bits_and_newest_stamp_are_those_of_the_evidence_that_holds():
    now, inside = read(repaved(-5, 4, 10)), area(-5, 4, 10, -1)
    outside = ~area(-5, 4, 10, 1)
    assert np.bitwise_count(now.bitmaps[..., ev.VISITS])[inside].max() <= 5  # minutes of the last pass
    assert np.bitwise_count(now.bitmaps[..., ev.VISITS])[outside].min() >= PASSES - 1
    assert (now.newest_ns >= NOW_NS + (PASSES - 1) * HOUR_NS).all()


def ages_of(begin_ns: int, cells: slice) -> dict[tuple[int, int], np.ndarray]:
    begins = np.zeros(ev.CELLS, np.int64)
    begins[cells] = begin_ns
    return {(0, 0): begins, (90, 90): begins}  # the last has no evidence


def firsts(grid: Grid, begin_ns: int, config: ChangeConfig = CONFIG) -> tuple[np.ndarray, list]:
    pages = {(0, 0): grid.pages([(0, 0)])[0]}
    valid = valid_pages(pages, grid.cell_m, config, ages_of(begin_ns, slice(0, 128)))
    assert set(valid) == {(0, 0)}
    return valid[0, 0], list(pages[0, 0])


def test_an_age_takes_the_pages_that_begin_in_it_in_its_cells_alone():
    grid = repaved(-30, -30, 4)  # nothing changed in this block
    first, pages = firsts(grid, NOW_NS + HOUR_NS + 1)
    assert {pages[i].first_ns for i in first[:128].tolist()} == {NOW_NS + 2 * HOUR_NS}
    assert (first[128:] == 0).all()


def test_where_nothing_was_driven_since_the_page_of_the_change_counts():
    grid = repaved(-30, -30, 4)
    last_ns = NOW_NS + (PASSES - 1) * HOUR_NS
    first, pages = firsts(grid, last_ns + 60 * 10**9)
    assert {pages[i].first_ns for i in first[:128].tolist()} == {last_ns}
    first, _ = firsts(grid, last_ns + 100 * HOUR_NS)
    assert (first == 0).all()  # old beats none


def test_an_age_before_a_change_of_the_cells_takes_nothing_back():
    grid = repaved(0, 0, 16)
    plain = valid_pages({b: grid.pages([b])[0] for b in [(0, 0)]}, 1.0, CONFIG)[0, 0]
    first, _ = firsts(grid, NOW_NS + 1)
    np.testing.assert_array_equal(np.maximum(first, plain), first)
    assert (first[128:] == plain[128:]).all()


def test_what_a_block_shows_is_the_same_where_it_alone_is_wanted():
    grid, reach = repaved(-10, -13, 20), reach_blocks(1.0, CONFIG)
    blocks = [(x, y) for y in range(-2, 2) for x in range(-2, 2)]
    pages = dict(zip(blocks, grid.pages(blocks), strict=True))
    whole = valid_pages(pages, 1.0, CONFIG)
    assert sum(first.any() for first in whole.values()) >= 4
    for block in blocks:
        near = {other: pages[other] for other in around(block, reach) if other in pages}
        assert (valid_pages(near, 1.0, CONFIG, only=[block])[block] == whole[block]).all()


def sweep(west: int, south: int, east: int, north: int, c_rr: float, hour: float, grade: float = 0.0):
    x, y = (v.ravel() + 0.5 for v in np.meshgrid(np.arange(west, east), np.arange(south, north)))
    stamps = NOW_NS + int(hour * HOUR_NS) + np.arange(len(x)) * 10**8
    return samples(len(x), x_m=x, y_m=y, c_rr=c_rr, grade_e=grade, grade_n=0.0, stamp_ns=stamps, cov_xx_m2=0.25)


def look(log: ChangeLog, grid: Grid, most: int = 1000) -> list[GroundChange]:
    changes, blocks = [], grid.take_touched(most)
    while blocks:
        wide = sorted({near for block in blocks for near in around(block, 1)})
        pages = {block: p for block, p in zip(wide, grid.pages(wide), strict=True) if p}
        changes += log.look(blocks, pages)
        blocks = grid.take_touched(most)
    return changes


def change_log(kept=(), **options) -> ChangeLog:
    return ChangeLog(1.0, ChangeConfig(**options), ReadConfig(), kept)


@pytest.fixture
def repaved_grid() -> Grid:
    """40 x 40 m of wet dirt driven twice, part of it gravel an hour later."""
    grid = Grid(1.0, FoldConfig())
    for hour in (0, 1):
        grid.fold(sweep(0, 0, 40, 40, 0.06, hour), "a")
    grid.fold(sweep(10, 10, 30, 25, 0.02, 2), "b")
    return grid


def test_a_change_says_where_when_and_from_what_to_what(repaved_grid):
    (change,) = look(change_log(), repaved_grid)
    west, south, east, north = change.bounds
    assert abs(np.array([west - 10, south - 10, east - 30, north - 25])).max() <= 2
    assert 200 < change.cells < 400
    assert NOW_NS + HOUR_NS < change.first_ns <= change.last_ns < NOW_NS + 2 * HOUR_NS + 300 * 10**9
    assert change.resistance_before == pytest.approx(0.06, rel=0.05)
    assert change.resistance_after == pytest.approx(0.02, rel=0.05)


def test_a_change_is_logged_once(repaved_grid):
    log = change_log()
    assert len(look(log, repaved_grid)) == 1
    repaved_grid.touch_all()
    assert look(log, repaved_grid) == []
    repaved_grid.fold(sweep(10, 10, 30, 25, 0.02, 3), "b")
    assert [c.id for c in look(log, repaved_grid)] in ([], [1])  # edge cells may be new


def test_a_change_grows_while_machines_pass():
    grid, log = Grid(1.0, FoldConfig()), change_log()
    for hour in (0, 1):
        grid.fold(sweep(0, 0, 60, 20, 0.06, hour), "a")
    look(log, grid)
    grid.fold(sweep(0, 0, 20, 20, 0.02, 2), "b")
    (first,) = look(log, grid)
    grid.fold(sweep(20, 0, 40, 20, 0.02, 2.5), "b")
    changes = look(log, grid)
    assert {change.id for change in changes} == {first.id}
    assert changes[-1].cells > 1.5 * first.cells
    assert changes[-1].bounds[2] > 35
    assert [c.id for c in log.changes()] == [first.id]


def test_a_second_change_of_the_same_ground_much_later_is_another(repaved_grid):
    log = change_log()
    look(log, repaved_grid)
    for hour in (30, 31):
        repaved_grid.fold(sweep(10, 10, 30, 25, 0.25, hour), "b")
    changes = look(log, repaved_grid)
    assert {change.id for change in changes} == {2}
    assert changes[-1].resistance_before == pytest.approx(0.02, rel=0.3)
    assert changes[-1].resistance_after == pytest.approx(0.25, rel=0.1)


def test_after_a_restart_nothing_is_logged_again(repaved_grid):
    log = change_log()
    look(log, repaved_grid)
    again = change_log([json.loads(json.dumps(asdict(change))) for change in log.changes()])
    repaved_grid.touch_all()
    assert look(again, repaved_grid) == []
    assert again.changes() == log.changes()
