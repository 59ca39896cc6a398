import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapserver.evidence import cells as ev
from mapserver.evidence.fold_config import TABLE, TABLE_LAST, FoldConfig
from mapserver.evidence.grid import Grid
from protocol.errors import MessageError
from protocol.machine.samples import check_samples
from tests.unit.mapserver.data import APART, NOW_NS, filled_to, folded, is_by_definition, same, samples, total

UNITS = ev.WEIGHT_UNITS_PER_M
HOUR_NS = 3600 * 10**9


metres = st.floats(-20_000, 20_000)
deviation = st.floats(0, 2.1)  # at most 3 m along any direction


@settings(max_examples=60)
@given(metres, metres, deviation, deviation, st.floats(-1, 1), st.floats(0, 100), st.sampled_from([0.25, 1.0, 100.0]))
def test_weights_of_a_sample_sum_exactly_to_its_weight(x, y, std_x, std_y, correlation, distance, cell_m):
    covariance = {"cov_xx_m2": std_x**2, "cov_yy_m2": std_y**2, "cov_xy_m2": 0.999 * correlation * std_x * std_y}
    rows = samples(x_m=x, y_m=y, distance_m=distance, **covariance)
    weight = round(float(rows["distance_m"][0]) * UNITS)
    counts = total(folded(rows, cell_m=cell_m))
    for votes in (ev.RESISTANCE, ev.GRADE_EAST, ev.GRADE_NORTH, ev.HEADING):
        assert counts[votes].sum() == weight


# Rows of every kind that the door admits: what is unknown, what stands still, what is nowhere, what is at a border.
edge = st.sampled_from([-32.0, -16.0, -0.5, 0.0, 7.5, 15.999, 16.0])
wide = st.one_of(st.floats(-40, 40), edge)
unknown = st.just(np.nan)
sample = st.fixed_dictionaries({
    "x_m": wide,
    "y_m": wide,
    "std_x": st.one_of(st.floats(0, 2.9), st.just(1000.0)),
    "std_y": st.one_of(st.floats(0, 2.9), st.just(1000.0)),
    "correlation": st.floats(-1, 1),
    "distance_m": st.one_of(st.floats(0, 100), st.sampled_from([0.0, 1e-5, 0.5 / UNITS, 1.5 / UNITS, 100.0])),
    "c_rr": st.one_of(st.floats(-1, 5, width=32), st.floats(0, 0.5, width=32), unknown),
    "grade_e": st.one_of(st.floats(-5, 5, width=32), st.floats(-0.625, 0.625, width=32), unknown),
    "heading_rad": st.floats(-7, 7, width=32),
    "stamp_ns": st.integers(NOW_NS - 5 * HOUR_NS, NOW_NS + 5 * HOUR_NS),
})  # fmt: skip


def admitted(drawn: list[dict[str, float]], shrunk: float = 1.0):
    """Samples as drawn, their standard deviations made smaller; the door admits every one of them."""
    column = {name: np.array([one[name] for one in drawn]) for name in drawn[0]}
    x, y = column.pop("std_x") * shrunk, column.pop("std_y") * shrunk
    column["cov_xy_m2"] = 0.999 * column.pop("correlation") * x * y
    rows = samples(len(drawn), cov_xx_m2=x * x, cov_yy_m2=y * y, grade_n=-0.7 * column["grade_e"], **column)
    rows["c_rr_var"] = np.where(np.isnan(rows["c_rr"]), np.nan, 1e-4)
    rows["grade_var"] = np.where(np.isnan(rows["grade_e"]), np.nan, 1e-4)
    check_samples(rows, 20_000.0)
    return rows


@settings(max_examples=40)
@given(st.lists(sample, min_size=1, max_size=10), st.sampled_from([0.5, 1.0, 7.3, 100.0]), st.integers(1, 8))
def test_the_grid_is_what_the_definition_says(drawn, cell_m, waiting_rows):
    rows = admitted(drawn)
    grid = folded(rows, cell_m=cell_m, waiting_rows=waiting_rows)
    assert is_by_definition(grid, rows)
    assert grid.folded + grid.skipped == len(rows)


@settings(max_examples=4)
@given(st.lists(sample, min_size=1, max_size=3))
def test_the_grid_is_what_the_definition_says_on_small_cells(drawn):
    rows = admitted(drawn, shrunk=0.1)
    assert is_by_definition(folded(rows, cell_m=0.05), rows)


def test_a_stencil_of_many_blocks_is_what_the_definition_says(monkeypatch):
    rows = samples(2, x_m=[3.3, -8.1], cov_xx_m2=6.0, cov_yy_m2=2.9, cov_xy_m2=3.0, distance_m=100.0)
    grid = folded(rows, cell_m=0.2)
    assert is_by_definition(grid, rows)
    assert len(grid.state().pages) > 16
    assert total(grid)[ev.HEADING].sum() == 2 * 100 * UNITS
    monkeypatch.setattr("mapserver.evidence.fold.MOST_SHARES", 100)  # one sample at a time
    assert same(folded(rows, cell_m=0.2), grid)


def test_only_full_counts_saturate():
    rows = samples(50, distance_m=100.0, cov_xx_m2=0.5, cov_yy_m2=0.5)
    near_full = filled_to(folded(rows).state(), ev.COUNT_MAX - 5_000_000)
    grid = Grid.from_state(1.0, FoldConfig(), near_full)
    grid.fold(rows, "a")
    counts = np.concatenate([at.page.votes["count"] for at in grid.state().pages])
    assert (counts == ev.COUNT_MAX).any()
    assert (counts < ev.COUNT_MAX).any()


@pytest.mark.parametrize("batch", [1500, 12_000])
def test_no_count_wraps_before_it_is_packed(batch):
    """Two headings of 6000 samples fit into 32 bits, what they share does not."""
    n, weight = 12_000, 100 * UNITS
    heading = np.where(np.arange(n) % 2, np.pi, 0.0)
    rows = samples(n, distance_m=100.0, cov_xx_m2=0, cov_yy_m2=0, heading_rad=heading, grade_e=0.125, stamp_ns=NOW_NS)
    grid = Grid(1.0, FoldConfig(), n)
    for first in range(0, n, batch):
        grid.fold(rows[first : first + batch], "a")
    counts = total(grid)
    assert n * weight > ev.COUNT_MAX
    assert counts[ev.HEADING][[0, 8]].tolist() == [n // 2 * weight] * 2
    assert counts[ev.GRADE_EAST][20] == counts[ev.GRADE_EAST].sum() == ev.COUNT_MAX


@pytest.mark.parametrize(("c_rr", "bin_"), [(-0.5, 0), (0.0, 0), (0.004, 0), (0.4, 23), (5.0, 23)])
def test_resistance_beyond_the_bins_votes_for_the_end(c_rr, bin_):
    counts = total(folded(samples(c_rr=c_rr, cov_xx_m2=0, cov_yy_m2=0, distance_m=4.0)))[ev.RESISTANCE]
    assert counts.argmax() == bin_
    assert counts[bin_] == counts.sum()


@pytest.mark.parametrize(("grade", "bin_"), [(-5.0, 0), (-0.5, 0), (0.0, 16), (0.5, 32), (5.0, 32)])
def test_grade_votes_lie_on_their_centres(grade, bin_):
    counts = total(folded(samples(grade_e=grade, grade_n=-grade)))
    assert counts[ev.GRADE_EAST].argmax() == bin_
    assert counts[ev.GRADE_NORTH].argmax() == 32 - bin_


@pytest.mark.parametrize(
    ("heading", "sector"), [(0.0, 0), (0.19, 0), (0.2, 1), (-0.19, 0), (-0.2, 15), (np.pi, 8), (-np.pi, 8), (6.9, 2)]
)
def test_heading_sectors_are_centred_on_east(heading, sector):
    assert total(folded(samples(heading_rad=heading)))[ev.HEADING].argmax() == sector


def test_a_sample_too_uncertain_is_the_newest_too():
    grid = folded(samples(2, stamp_ns=[NOW_NS, NOW_NS + 9], cov_xx_m2=[0.0, 100.0]))
    assert grid.newest_ns == NOW_NS + 9
    assert grid.evidence([(0, 0)]).newest_ns.max() == NOW_NS


@pytest.mark.parametrize("cap", [3.0, 1.0])
def test_a_sample_too_uncertain_is_counted_not_folded(cap):
    rows = samples(4, cov_xx_m2=[cap**2, cap**2 * 1.01, 0.0, 0.0], cov_yy_m2=[0.0, 0.0, cap**2 * 1.01, 0.0])
    grid = folded(rows, std_cap_m=cap)
    assert (grid.folded, grid.skipped) == (2, 2)
    oblique = samples(cov_xx_m2=0.9 * cap**2, cov_yy_m2=0.9 * cap**2, cov_xy_m2=0.5 * cap**2)
    assert folded(oblique, std_cap_m=cap).skipped == 1  # sure east and north, but not along the diagonal


def test_bucket_length_decides_the_buckets():
    rows = samples(10, stamp_ns=NOW_NS + np.arange(10) * 60 * 10**9)
    pages = [folded(rows, bucket_s=s, **APART).state().pages for s in (60.0, 300.0, 600.0)]
    assert [*map(len, pages)] == [10, 2, 1]
    assert [at.index * 300 * 10**9 for at in pages[1]] == [NOW_NS, NOW_NS + 300 * 10**9]


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("bucket_s", (59.0, 3601.0, 7200.0, 700.0, 3600 / 7, float("nan"))),
        *((name, (0, 1001)) for name in ("keep_buckets", "keep_hours", "keep_days")),
        ("std_cap_m", (0.3, 31.0)),
    ],
)
def test_bad_option_is_refused_by_name(name, values):
    for value in values:
        with pytest.raises(ValueError, match=name):
            FoldConfig(**{name: value})


def test_covariances_that_only_rounding_lets_pass_vote_as_the_definition_says():
    xx = np.linspace(1.0, 449.9, 20)
    rows = samples(20, cov_xx_m2=xx, cov_yy_m2=xx, cov_xy_m2=xx * (1 + 4e-7))
    grid = folded(rows, cell_m=7.3, std_cap_m=30.0)
    assert total(grid)[ev.HEADING].sum() == 20 * UNITS
    assert is_by_definition(grid, rows)


@pytest.mark.parametrize("column", ["cov_xx_m2", "cov_xy_m2", "cov_yy_m2"])
def test_a_covariance_that_is_no_number_has_no_vote(column):
    """The door refuses it; should one come by another way, it must not reach the table."""
    rows = samples(3)
    rows[column][1] = np.nan
    with pytest.raises(MessageError):
        check_samples(rows, 20_000.0)
    grid = folded(rows)
    assert (grid.folded, grid.skipped) == (2, 1)


def test_table_falls_to_three_sigma_and_is_nothing_beyond():
    assert len(TABLE) == TABLE_LAST + 1
    assert TABLE[0] == 65536
    assert (np.diff(TABLE) <= 0).all()
    assert TABLE[-2] == round(65536 * np.exp(-4.5))
    assert TABLE[-1] == 0
