from dataclasses import replace

import numpy as np
import pytest
from mapserver_data import NOW_NS, samples

from mapserver import evidence as ev
from mapserver.change import ChangeConfig, first_valid, without_thin
from mapserver.grid import Grid
from mapserver.ladder import TimedPage
from mapserver.votes import FoldConfig
from protocol.arrays import Bools, Ints

CONFIG = ChangeConfig()
HOUR_NS = 3600 * 10**9
CENTRES = np.arange(16) + 0.5
BIN = float(np.log(ev.RESISTANCE_CENTRES[1] / ev.RESISTANCE_CENTRES[0]))


def passes(*grounds: float, column: str = "c_rr", distance_m: float = 1.0, noise: float = 0.0) -> list[TimedPage]:
    """Pages of one block that is driven all over once an hour, with the ground as given."""
    x, y = (axis.ravel() for axis in np.meshgrid(CENTRES, CENTRES))
    grid, draw = Grid(1.0, FoldConfig(keep_buckets=100)), np.random.default_rng(1)
    for hour, ground in enumerate(grounds):
        values = ground * np.exp(noise * draw.normal(size=256)) if column == "c_rr" else ground
        usual = {"x_m": x, "y_m": y, "stamp_ns": NOW_NS + hour * HOUR_NS, "distance_m": distance_m}
        grid.fold(samples(256, **usual | {column: values, "cov_xx_m2": 0, "cov_yy_m2": 0}), "a")
    return grid.pages([(0, 0)])[0]


def firsts(pages: list[TimedPage], config: ChangeConfig = CONFIG) -> Ints:
    return np.unique(first_valid(pages, config))


# --- one block -------------------------------------------------------------------------------------------------------


def test_ground_that_stays_as_it_is_keeps_all_its_evidence():
    assert firsts(passes(0.04, 0.04, 0.04)) == [0]
    assert firsts(passes(*[0.04] * 6, noise=0.05)) == [0]


@pytest.mark.parametrize("old", [1, 3, 6])
def test_ground_that_changed_is_seen_after_one_pass(old):
    assert firsts(passes(*[0.04] * old, 0.2)) == [old]


@pytest.mark.parametrize("column", ["c_rr", "grade_e", "grade_n"])
def test_every_kind_of_vote_tells_a_change(column):
    old, new = (0.04, 0.2) if column == "c_rr" else (0.1, -0.2)
    assert firsts(passes(old, old, new, new, column=column)) == [2]


def test_of_two_changes_the_last_counts():
    assert firsts(passes(0.04, 0.04, 0.2, 0.2, 0.01, 0.01)) == [4]
    assert firsts(passes(0.04, 0.04, 0.2, 0.2, 0.04)) == [4]
    assert firsts(passes(0.04, 0.2, 0.01)) == [2]


def test_the_later_of_a_change_of_resistance_and_one_of_grade_counts():
    x, y = (axis.ravel() for axis in np.meshgrid(CENTRES, CENTRES))
    for order in ([("c_rr", 0.2), ("grade_e", -0.3)], [("grade_e", -0.3), ("c_rr", 0.2)]):
        ground = {"c_rr": 0.04, "grade_e": 0.1}
        grid = Grid(1.0, FoldConfig(keep_buckets=100))
        for hour, change in enumerate([(), (), order[0], (), order[1], ()]):
            ground |= dict([change]) if change else {}
            rows = samples(256, x_m=x, y_m=y, stamp_ns=NOW_NS + hour * HOUR_NS, cov_xx_m2=0, cov_yy_m2=0, **ground)
            grid.fold(rows, "a")
        assert firsts(grid.pages([(0, 0)])[0]) == [4]


def test_one_page_or_none_has_no_change():
    assert first_valid([], CONFIG).tolist() == [0] * 256
    assert firsts(passes(0.2)) == [0]


def test_cells_change_each_on_their_own():
    x, y = (axis.ravel() for axis in np.meshgrid(CENTRES, CENTRES))
    grid = Grid(1.0, FoldConfig())
    for hour in range(3):
        c_rr = np.where((x > 8) & (hour == 2), 0.2, 0.04)
        rows = samples(256, x_m=x, y_m=y, stamp_ns=NOW_NS + hour * HOUR_NS, cov_xx_m2=0, cov_yy_m2=0, c_rr=c_rr)
        grid.fold(rows, "a")
    first = first_valid(grid.pages([(0, 0)])[0], CONFIG).reshape(16, 16)
    assert (first[:, 8:] == 2).all()
    assert (first[:, :8] == 0).all()


# --- options ---------------------------------------------------------------------------------------------------------


def test_detect_off_keeps_everything():
    assert firsts(passes(0.04, 0.2), replace(CONFIG, detect=False)) == [0]


def test_medians_nearer_than_bins_are_no_change():
    pages = passes(0.04, 0.04 * np.exp(2.5 * BIN))
    assert firsts(pages, replace(CONFIG, bins=2.4)) == [1]
    assert firsts(pages, replace(CONFIG, bins=2.6)) == [0]


def test_histograms_that_have_more_in_common_than_variation_are_no_change():
    x, y = (axis.ravel() for axis in np.meshgrid(CENTRES, CENTRES))
    grid = Grid(1.0, FoldConfig())
    for hour, distances in enumerate(((0.8, 0.2), (0.1, 0.9))):  # metres of 0.04 and of 0.2: 0.7 of them differ
        for c_rr, distance_m in zip((0.04, 0.2), distances, strict=True):
            stamp_ns = NOW_NS + hour * HOUR_NS
            rows = samples(256, x_m=x, y_m=y, stamp_ns=stamp_ns, c_rr=c_rr, distance_m=distance_m, cov_xx_m2=0)
            rows["cov_yy_m2"] = 0
            grid.fold(rows, "a")
    pages = grid.pages([(0, 0)])[0]
    assert firsts(pages, replace(CONFIG, variation=0.65)) == [1]
    assert firsts(pages, replace(CONFIG, variation=0.75)) == [0]


@pytest.mark.parametrize("distances", [(0.25, 2.0), (2.0, 0.25)])
def test_less_evidence_than_weight_on_either_side_is_no_change(distances):
    x, y = (axis.ravel() for axis in np.meshgrid(CENTRES, CENTRES))
    grid = Grid(1.0, FoldConfig())
    for hour, (c_rr, distance_m) in enumerate(zip((0.04, 0.2), distances, strict=True)):
        stamp_ns = NOW_NS + hour * HOUR_NS
        rows = samples(256, x_m=x, y_m=y, stamp_ns=stamp_ns, c_rr=c_rr, distance_m=distance_m, cov_xx_m2=0)
        rows["cov_yy_m2"] = 0
        grid.fold(rows, "a")
    pages = grid.pages([(0, 0)])[0]
    assert firsts(pages, replace(CONFIG, weight_m=0.2)) == [1]
    assert firsts(pages, replace(CONFIG, weight_m=0.3)) == [0]


@pytest.mark.parametrize(
    ("name", "value"),
    [("variation", 0.0), ("variation", 1.0), ("bins", 0.0), ("weight_m", -1.0), ("size_m", 0.0), ("size_m", np.nan)],
)
def test_bad_option_is_refused_by_name(name, value):
    with pytest.raises(ValueError, match=name):
        ChangeConfig(**{name: value})


# --- thin areas ------------------------------------------------------------------------------------------------------


def square(edge: int, column: int = 12, row: int = 10) -> Bools:
    image: Bools = np.zeros((40, 40), np.bool_)
    image[row : row + edge, column : column + edge] = True
    return image


EVEN = pytest.mark.xfail(strict=True, reason="an even square is not mirrored for the dilation: one row, one column off")


@pytest.mark.parametrize("edge", [1, pytest.param(2, marks=EVEN), 3, 5, pytest.param(10, marks=EVEN), 11])
def test_an_area_of_the_least_size_is_kept_as_it_is(edge):
    assert np.array_equal(without_thin(square(edge), 1.0, replace(CONFIG, size_m=float(edge))), square(edge))


@pytest.mark.parametrize("edge", [2, 3, 4, 5, 10])
def test_an_area_narrower_than_the_least_size_is_left_out(edge):
    strip = square(edge) & square(edge - 1, 12, 10)
    assert not without_thin(strip, 1.0, replace(CONFIG, size_m=float(edge))).any()
    assert not without_thin(strip.T, 1.0, replace(CONFIG, size_m=float(edge))).any()


def test_size_is_in_metres():
    config = replace(CONFIG, size_m=3.0)
    assert without_thin(square(6), 1.0, config).any()
    assert not without_thin(square(6), 0.4, config).any()  # 8 cells, and 6 are too few
    assert without_thin(square(1), 5.0, config).sum() == 1  # never less than a cell


@pytest.mark.parametrize(("row", "column"), [(0, 0), (0, 35), (35, 0), (35, 35), (20, 35)])
def test_an_area_at_the_images_border_is_kept_and_what_is_cut_by_it_is_not_guessed(row, column):
    assert np.array_equal(without_thin(square(5, column, row), 1.0, CONFIG), square(5, column, row))
    assert not without_thin(square(5, column, row)[:, :38] & square(5, 36, row)[:, :38], 1.0, CONFIG).any()
