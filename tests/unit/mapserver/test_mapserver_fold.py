import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mapserver_data import NOW_NS, folded, random_samples, same, samples, total

from mapserver import evidence as ev
from mapserver.fold import fold_numpy, kernel
from mapserver.grid import Grid
from mapserver.votes import TABLE, FoldConfig, prepare
from protocol.ground import ZONES

UNITS = ev.WEIGHT_UNITS_PER_M
KERNELS = ("numpy", "numba")


def merged(parts) -> Grid:
    """Add grids that were folded apart."""
    total_grid = Grid(1.0, FoldConfig())
    for part in parts:
        state = part.state()
        for i, code in enumerate(state.codes):
            slot = total_grid._slot(int(code))
            total_grid._counts[slot] += state.counts[i]
            total_grid._bitmaps[slot] |= state.bitmaps[i]
            total_grid._newest[slot] = np.maximum(total_grid._newest[slot], state.newest[i])
        total_grid.folded += state.folded
        total_grid.skipped += state.skipped
    return total_grid


# --- weights ---------------------------------------------------------------------------------------------------------

metres = st.floats(-20_000, 20_000)
deviation = st.floats(0, 2.1)  # at most 3 m along any direction


@settings(max_examples=60)
@given(metres, metres, deviation, deviation, st.floats(-1, 1), st.floats(0, 100), st.sampled_from([0.25, 1.0, 100.0]))
def test_weights_of_a_sample_sum_exactly_to_its_weight(x, y, std_x, std_y, correlation, distance, cell_m):
    covariance = {"cov_xx_m2": std_x**2, "cov_yy_m2": std_y**2, "cov_xy_m2": 0.999 * correlation * std_x * std_y}
    rows = samples(x_m=x, y_m=y, distance_m=distance, **covariance)
    weight = round(float(rows["distance_m"][0]) * UNITS)
    for name in KERNELS:
        counts = total(folded(rows, cell_m=cell_m, kernel=name))
        for votes in (ev.RESISTANCE, ev.GRADE_EAST, ev.GRADE_NORTH, ev.HEADING):
            assert counts[votes].sum() == weight, name
        assert counts[ev.WEIGHT] == weight, name


@pytest.mark.parametrize("cell_m", [0.25, 1.0, 100.0])
@pytest.mark.parametrize("seed", range(4))
def test_both_kernels_agree_to_the_bit(seed, cell_m):
    rows = random_samples(150, seed)
    rows["distance_m"][:10] = 0.0
    assert same(*(folded(rows, cell_m=cell_m, kernel=name) for name in KERNELS))


def test_weight_falls_off_with_the_covariance():
    rows = samples(cov_xx_m2=1.0, cov_yy_m2=0.04, distance_m=100.0)
    weight = folded(rows).evidence([(0, 0)]).counts[0, :, ev.WEIGHT].reshape(16, 16).astype(float)
    middle = weight[8, 8]
    assert weight[8, 9] / middle == pytest.approx(np.exp(-0.5 / 1.09), rel=0.01)  # one metre off, variance 1 + 0.3**2
    assert weight[9, 8] / middle == pytest.approx(np.exp(-0.5 / 0.13), rel=0.02)
    assert weight[8, 7] == weight[8, 9]
    assert weight[7, 8] == weight[9, 8]


def test_correlation_turns_the_spread():
    rows = samples(cov_xx_m2=1.0, cov_yy_m2=1.0, cov_xy_m2=0.9, distance_m=100.0)
    weight = folded(rows).evidence([(0, 0)]).counts[0, :, ev.WEIGHT].reshape(16, 16)
    assert weight[9, 9] == weight[7, 7] > 10 * weight[9, 7]
    assert weight[9, 7] == weight[7, 9]


def test_a_parked_machine_has_no_vote():
    grid = folded(samples(5, distance_m=0.0))
    assert grid.known_cells() == 0
    assert not total(grid).any()
    assert not grid.state().bitmaps.any()


def test_position_in_a_cell_decides_where_the_votes_go():
    grid = folded(samples(2, x_m=[-0.5, 0.5], y_m=[-0.5, 0.5], distance_m=10.0))
    south_west, north_east = grid.evidence([(-1, -1), (0, 0)]).counts[..., ev.WEIGHT]
    assert (south_west.argmax(), north_east.argmax()) == (15 * 16 + 15, 0)


# --- order and batching ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", KERNELS)
@settings(max_examples=8)
@given(st.integers(0, 2**32 - 1), st.lists(st.integers(0, 80), max_size=5))
def test_any_order_and_any_batching_give_the_same_bits(name, seed, cuts):
    rows = random_samples(80, 1)
    whole = folded(rows, kernel=name)
    shuffled = rows[np.random.default_rng(seed).permutation(len(rows))]
    grid = Grid(1.0, FoldConfig(kernel=name))
    for part in np.split(shuffled, sorted(cuts)):
        grid.fold(part, "a")
    assert same(grid, whole)


@pytest.mark.parametrize("cut", [0, 1, 100, 300])
def test_two_grids_added_are_the_grid_of_all(cut):
    rows = random_samples(300, 2)
    assert same(merged([folded(rows[:cut]), folded(rows[cut:])]), folded(rows))


def test_machines_mix_in_any_order():
    one, two = random_samples(100, 3), random_samples(100, 4)
    there, back = Grid(1.0, FoldConfig()), Grid(1.0, FoldConfig())
    there.fold(one, "a"), there.fold(two, "b")
    back.fold(two, "b"), back.fold(one, "a")
    assert same(there, back)


@pytest.mark.parametrize("name", KERNELS)
def test_counts_saturate_instead_of_wrapping(name):
    rows = samples(3, distance_m=[100.0, 50.0, 75.0], cov_xx_m2=0, cov_yy_m2=0)
    near_full = folded(rows, kernel=name)
    peak = near_full._counts.max(axis=2).argmax()
    near_full._counts[near_full._counts > 0] = ev.COUNT_MAX - 1000
    grids = []
    for order in ([0, 1, 2], [2, 0, 1], [1, 2, 0]):
        grid = Grid.from_state(1.0, FoldConfig(kernel=name), near_full.state())
        for i in order:
            grid.fold(rows[i : i + 1], "a")
        grids.append(grid)
    assert grids[0]._counts.reshape(-1, ev.COUNTS)[peak, ev.WEIGHT] == ev.COUNT_MAX
    assert same(grids[0], grids[1])
    assert same(grids[0], grids[2])


def test_saturation_is_the_same_in_both_kernels():
    rows = samples(50, distance_m=100.0, cov_xx_m2=0.5, cov_yy_m2=0.5)
    grids = []
    for name in KERNELS:
        grid = folded(rows, kernel=name)
        grid._counts[grid._counts > 0] = ev.COUNT_MAX - 5_000_000
        grid.fold(rows, "a")
        assert (grid._counts == ev.COUNT_MAX).any()
        assert (grid._counts < ev.COUNT_MAX).any()
        grids.append(grid)
    assert same(*grids)


# --- what votes for what ---------------------------------------------------------------------------------------------


def test_a_sample_without_resistance_votes_for_grade_alone():
    counts = total(folded(samples(c_rr=np.nan, c_rr_var=np.nan)))
    assert not counts[ev.RESISTANCE].any()
    assert counts[ev.GRADE_EAST].sum() == counts[ev.GRADE_NORTH].sum() == counts[ev.WEIGHT] == UNITS


def test_a_sample_without_grade_votes_for_resistance_alone():
    counts = total(folded(samples(grade_e=np.nan, grade_n=np.nan, grade_var=np.nan)))
    assert not counts[ev.GRADE_EAST].any()
    assert not counts[ev.GRADE_NORTH].any()
    assert counts[ev.RESISTANCE].sum() == UNITS


@pytest.mark.parametrize("name", KERNELS)
@pytest.mark.parametrize(("c_rr", "bin_"), [(-0.5, 0), (0.0, 0), (0.004, 0), (0.4, 23), (5.0, 23)])
def test_resistance_beyond_the_bins_votes_for_the_end(c_rr, bin_, name):
    counts = total(folded(samples(c_rr=c_rr, cov_xx_m2=0, cov_yy_m2=0, distance_m=4.0), kernel=name))[ev.RESISTANCE]
    assert counts.argmax() == bin_
    assert counts[bin_] == counts.sum()


@pytest.mark.parametrize(("grade", "bin_"), [(-5.0, 0), (-0.5, 0), (0.0, 16), (0.5, 32), (5.0, 32)])
def test_grade_votes_lie_on_their_centres(grade, bin_):
    counts = total(folded(samples(grade_e=grade, grade_n=-grade)))
    assert counts[ev.GRADE_EAST].argmax() == bin_
    assert counts[ev.GRADE_NORTH].argmax() == 32 - bin_


def test_a_vote_is_split_linearly_between_two_bins():
    lower, share = ev.split_grade(np.array([0.25 / 32]))
    assert (lower[0], share[0]) == (16, 64)
    lower, share = ev.split_resistance(np.sqrt(ev.RESISTANCE_CENTRES[3:4] * ev.RESISTANCE_CENTRES[4:5]))
    assert (lower[0], share[0]) == (3, 128)
    assert [int(part[0]) for part in ev.split_grade(np.array([np.nan]))] == [-1, 0]


def test_neighbouring_zones_are_at_least_two_bins_apart():
    lower, share = ev.split_resistance(np.array([zone.c_rr for zone in ZONES]))
    assert np.diff(lower + share / ev.SHARE_ONE).min() > 1.9


@pytest.mark.parametrize(
    ("heading", "sector"), [(0.0, 0), (0.19, 0), (0.2, 1), (-0.19, 0), (-0.2, 15), (np.pi, 8), (-np.pi, 8), (6.9, 2)]
)
def test_heading_sectors_are_centred_on_east(heading, sector):
    assert total(folded(samples(heading_rad=heading)))[ev.HEADING].argmax() == sector


def test_a_machine_and_its_visit_set_one_bit_each_and_stay():
    rows = samples(3, stamp_ns=NOW_NS + np.array([0, 1, 59]) * 10**9)
    bits = np.bitwise_count(folded(rows).state().bitmaps).max(axis=(0, 1))
    assert bits.tolist() == [1, 1]  # within a minute: one visit
    later = folded(samples(2, stamp_ns=NOW_NS + np.array([0, 120]) * 10**9))
    assert np.bitwise_count(later.state().bitmaps).max(axis=(0, 1)).tolist() == [2, 1]


def test_newest_stamp_wins_in_any_order():
    grid = folded(samples(3, stamp_ns=[NOW_NS + 5, NOW_NS + 9, NOW_NS + 7]))
    assert grid.state().newest.max() == NOW_NS + 9


# --- options ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cap", [3.0, 1.0])
def test_a_sample_too_unsure_of_its_place_is_counted_not_folded(cap):
    rows = samples(4, cov_xx_m2=[cap**2, cap**2 * 1.01, 0.0, 0.0], cov_yy_m2=[0.0, 0.0, cap**2 * 1.01, 0.0])
    grid = folded(rows, std_cap_m=cap)
    assert (grid.folded, grid.skipped) == (2, 2)
    oblique = samples(cov_xx_m2=0.9 * cap**2, cov_yy_m2=0.9 * cap**2, cov_xy_m2=0.5 * cap**2)
    assert folded(oblique, std_cap_m=cap).skipped == 1  # sure east and north, but not along the diagonal


def test_floor_spreads_a_sample_that_claims_to_be_exact():
    rows = samples(cov_xx_m2=0.0, cov_yy_m2=0.0, distance_m=100.0)
    cells = [folded(rows, std_floor_m=floor).known_cells() for floor in (0.3, 0.5, 1.0)]
    assert cells[0] == 1
    assert cells == sorted(set(cells)), cells


def test_bucket_length_decides_the_buckets():
    rows = samples(10, stamp_ns=NOW_NS + np.arange(10) * 60 * 10**9)
    assert [len(folded(rows, bucket_s=s).state().codes) for s in (60.0, 300.0, 600.0)] == [10, 2, 1]


def test_kernel_option_is_obeyed():
    assert kernel("numpy") is fold_numpy
    assert kernel("numba") is kernel("auto")
    assert kernel("numba").__name__ == "fold_numba"


def test_auto_falls_back_to_numpy_where_numba_is_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "mapserver.fold_numba", None)
    assert kernel("auto") is fold_numpy
    with pytest.raises(ImportError):
        kernel("numba")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("bucket_s", 59.0),
        ("bucket_s", 86_401.0),
        ("std_floor_m", 0.0),
        ("std_floor_m", 0.009),
        ("std_floor_m", 3.0),
        ("std_cap_m", 0.3),
        ("std_cap_m", 31.0),
        ("kernel", "cuda"),
    ],
)
def test_bad_option_is_refused_by_name(name, value):
    with pytest.raises(ValueError, match=name):
        FoldConfig(**{name: value})


def test_least_floor_keeps_every_admitted_covariance_invertible():
    std = np.linspace(0.0, 3.0, 40)
    xx, yy = (axis.ravel() for axis in np.meshgrid(std**2, std**2))
    xy = np.sqrt(xx * yy) * (1 + 4e-7)  # what rounding lets pass
    rows = samples(len(xx), cov_xx_m2=xx, cov_yy_m2=yy, cov_xy_m2=xy)
    votes = prepare(rows, "a", 1.0, FoldConfig(std_floor_m=0.01))
    a, b, c = votes.inverse.T
    assert (a > 0).all()
    assert (a * c > b * b / 4).all()


def test_table_falls_from_one_to_three_sigma():
    assert TABLE[0] == 65536
    assert (np.diff(TABLE) <= 0).all()
    assert TABLE[-1] == round(65536 * np.exp(-4.5))
