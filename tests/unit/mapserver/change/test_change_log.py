import json
from dataclasses import asdict

import numpy as np
import pytest

from mapserver.change.change_log import ChangeLog
from mapserver.change.detection import ChangeConfig
from mapserver.change.validity import around
from mapserver.evidence.fold_config import FoldConfig
from mapserver.evidence.grid import Grid
from mapserver.layers.cell_layers import ReadConfig
from protocol.queries.answers import GroundChange
from tests.unit.mapserver.data import NOW_NS, samples

HOUR_NS = 3600 * 10**9


def sweep(west: int, south: int, east: int, north: int, c_rr: float, hour: float, grade: float = 0.0):
    """A pass over every metre of a rectangle, a second each."""
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
def repaved() -> Grid:
    """40 x 40 m of wet dirt, driven twice; a part of it is gravel an hour later."""
    grid = Grid(1.0, FoldConfig())
    for hour in (0, 1):
        grid.fold(sweep(0, 0, 40, 40, 0.06, hour), "a")
    grid.fold(sweep(10, 10, 30, 25, 0.02, 2), "b")
    return grid


def test_a_change_says_where_when_and_from_what_to_what(repaved):
    (change,) = look(change_log(), repaved)
    west, south, east, north = change.bounds
    assert abs(np.array([west - 10, south - 10, east - 30, north - 25])).max() <= 2
    assert 200 < change.cells < 400
    assert NOW_NS + HOUR_NS < change.first_ns <= change.last_ns < NOW_NS + 2 * HOUR_NS + 300 * 10**9
    assert change.resistance_before == pytest.approx(0.06, rel=0.05)
    assert change.resistance_after == pytest.approx(0.02, rel=0.05)


def test_a_change_is_logged_once(repaved):
    log = change_log()
    assert len(look(log, repaved)) == 1
    repaved.touch_all()
    assert look(log, repaved) == []
    repaved.fold(sweep(10, 10, 30, 25, 0.02, 3), "b")
    assert [c.id for c in look(log, repaved)] in ([], [1])  # a few cells at its edge may be new


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


def test_changes_far_apart_are_two(repaved):
    for hour in (0, 1):
        repaved.fold(sweep(200, 200, 220, 220, 0.008, hour), "a")
    repaved.fold(sweep(200, 200, 220, 220, 0.06, 2), "b")
    log = change_log()
    assert sorted(change.id for change in look(log, repaved)) == [1, 2]
    assert [change.id for change in log.changes(after=1)] == [2]


def test_a_second_change_of_the_same_ground_much_later_is_another(repaved):
    log = change_log()
    look(log, repaved)
    for hour in (30, 31):
        repaved.fold(sweep(10, 10, 30, 25, 0.25, hour), "b")
    changes = look(log, repaved)
    assert {change.id for change in changes} == {2}
    assert changes[-1].resistance_before == pytest.approx(0.02, rel=0.3)
    assert changes[-1].resistance_after == pytest.approx(0.25, rel=0.1)


def test_after_a_restart_nothing_is_logged_again(repaved):
    log = change_log()
    look(log, repaved)
    again = change_log([json.loads(json.dumps(asdict(change))) for change in log.changes()])
    repaved.touch_all()
    assert look(again, repaved) == []
    assert again.changes() == log.changes()
