from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapserver.evidence import cells as ev
from mapserver.evidence import grid as grid_module
from mapserver.evidence.fold_config import TABLE, TABLE_LAST, FoldConfig
from mapserver.evidence.grid import LIVE_ROWS, Grid
from mapserver.journal.history import lent
from protocol.arrays import Table
from protocol.machine.samples import check_samples, empty
from tests.unit.mapserver.data import APART, NOW_NS, folded, is_by_definition, same, samples, total

UNITS = ev.WEIGHT_UNITS_PER_M
HOUR_NS = 3600 * 10**9


# All kinds of admissible row: unknown, still, nowhere, at borders.
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
    "c_rr_var": st.one_of(st.floats(0, 2e-3), st.sampled_from([0.0, 1e-4, 0.03, 100.0])),
    "grade_e": st.one_of(st.floats(-5, 5, width=32), st.floats(-0.625, 0.625, width=32), unknown),
    "heading_rad": st.floats(-7, 7, width=32),
    "stamp_ns": st.integers(NOW_NS - 5 * HOUR_NS, NOW_NS + 5 * HOUR_NS),
})  # fmt: skip


def admitted(drawn: list[dict[str, float]], shrunk: float = 1.0):
    """Samples as drawn, standard deviations reduced; all admitted."""
    column = {name: np.array([one[name] for one in drawn]) for name in drawn[0]}
    x, y = column.pop("std_x") * shrunk, column.pop("std_y") * shrunk
    column["cov_xy_m2"] = 0.999 * column.pop("correlation") * x * y
    rows = samples(len(drawn), cov_xx_m2=x * x, cov_yy_m2=y * y, grade_n=-0.7 * column["grade_e"], **column)
    rows["c_rr_var"] = np.where(np.isnan(rows["c_rr"]), np.nan, column["c_rr_var"])
    rows["grade_var"] = np.where(np.isnan(rows["grade_e"]), np.nan, 1e-4)
    check_samples(rows, 20_000.0)
    return rows


@settings(max_examples=20)
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
    monkeypatch.setattr("mapserver.evidence.fold.MOST_SHARES", 100)  # a sample at a time
    assert same(folded(rows, cell_m=0.2), grid)


@pytest.mark.parametrize("batch", [1500, 12_000])
def test_no_count_wraps_before_it_is_packed(batch):
    """Two headings of 6000 samples fit 32 bits, their common counts do not."""
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
    assert folded(oblique, std_cap_m=cap).skipped == 1  # certain east and north, not along the diagonal


def test_bucket_length_decides_the_buckets():
    rows = samples(10, stamp_ns=NOW_NS + np.arange(10) * 60 * 10**9)
    pages = [folded(rows, bucket_s=s, **APART).state().pages for s in (60.0, 300.0, 600.0)]
    assert [*map(len, pages)] == [10, 2, 1]
    assert [at.index * 300 * 10**9 for at in pages[1]] == [NOW_NS, NOW_NS + 300 * 10**9]


def test_covariances_that_only_rounding_lets_pass_vote_as_the_definition_says():
    xx = np.linspace(1.0, 449.9, 20)
    rows = samples(20, cov_xx_m2=xx, cov_yy_m2=xx, cov_xy_m2=xx * (1 + 4e-7))
    grid = folded(rows, cell_m=7.3, std_cap_m=30.0)
    assert total(grid)[ev.HEADING].sum() == 20 * UNITS
    assert is_by_definition(grid, rows)


def test_table_falls_to_three_sigma_and_is_nothing_beyond():
    assert len(TABLE) == TABLE_LAST + 1
    assert TABLE[0] == 65536
    assert (np.diff(TABLE) <= 0).all()
    assert TABLE[-2] == round(65536 * np.exp(-4.5))
    assert TABLE[-1] == 0


CONFIG = FoldConfig()
DAY_NS = 86_400 * 10**9
START_NS = 1_767_225_600 * 10**9
Batches = list[tuple[str, Table]]


def batches(seed: int, *, n: int = 150, days: float = 1.0, spread_m: float = 8.0, machines: int = 3) -> Batches:
    """Hard samples: unknown values, uncertain and tilted positions, no distance, any order."""
    rng = np.random.default_rng(seed)
    rows = empty(n)
    rows["stamp_ns"] = START_NS + (rng.random(n) * days * DAY_NS).astype(np.int64)
    rows["x_m"], rows["y_m"] = rng.normal(0.0, spread_m, (2, n))
    std_x, std_y, rho = rng.uniform(0.0, 3.2, n), rng.uniform(0.0, 3.2, n), rng.uniform(-0.99, 0.99, n)
    rows["cov_xx_m2"], rows["cov_yy_m2"], rows["cov_xy_m2"] = std_x**2, std_y**2, rho * std_x * std_y
    rows["heading_rad"] = rng.uniform(-7.0, 7.0, n)
    rows["distance_m"] = rng.choice([0.0, 0.5, 1.0, 90.0], n)
    rows["c_rr"] = np.where(rng.random(n) < 0.3, np.nan, rng.uniform(-0.5, 1.0, n))
    unknown = rng.random(n) < 0.3
    rows["grade_e"], rows["grade_n"] = (np.where(unknown, np.nan, rng.normal(0.0, 0.3, n)) for _ in range(2))
    cuts = sorted({0, n, *rng.integers(0, n, 6).tolist()})
    return [(f"loader-{rng.integers(machines)}", rows[first:end]) for first, end in pairwise(cuts)]


def grid_of(parts: Batches, waiting_rows: int = LIVE_ROWS, cell_m: float = 1.0) -> Grid:
    grid = Grid(cell_m, CONFIG, waiting_rows)
    for machine, rows in parts:
        grid.fold(rows, machine)
    return grid


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.01, 1.0, 60.0]), st.sampled_from([1, 7, 100, 8192]))
def test_how_many_samples_wait_and_in_which_order_they_come_does_not_matter(seed: int, days: float, rows: int) -> None:
    parts = batches(seed, days=days)
    shuffled = [parts[i] for i in np.random.default_rng(seed).permutation(len(parts))]
    assert same(grid_of(parts), grid_of(shuffled, rows))


@settings(max_examples=12)
@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from([0.01, 1.0, 60.0, 400.0]),
    st.sampled_from([1, 2, 3]),
    st.sampled_from([1, 9, 131_072]),
)
def test_how_many_threads_fold_does_not_matter(seed: int, days: float, count: int, rows: int) -> None:
    parts = batches(seed, days=days, spread_m=30.0)
    grid = grid_of(parts[:2])
    with pytest.MonkeyPatch.context() as patch, lent(count) as workers:
        patch.setattr(grid_module, "REFOLD_ROWS", rows)
        with grid.bulk(workers):
            for machine, part in parts[2:]:
                grid.fold(part, machine)
    assert same(grid, grid_of(parts))
    more = batches(seed + 1, days=days)
    for machine, part in more:
        grid.fold(part, machine)
    assert same(grid, grid_of(parts + more)), "it is an ordinary grid again"


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.01, 1.0, 60.0, 400.0]), st.integers(1, 4))
def test_a_merge_of_folds_is_the_fold_of_all(seed: int, days: float, more: int) -> None:
    parts = batches(seed, days=days)
    rng = np.random.default_rng(seed)
    owner = rng.integers(more + 1, size=len(parts))
    grids = [grid_of([part for part, at in zip(parts, owner, strict=True) if at == n]) for n in range(more + 1)]
    while len(grids) > 1:  # any tree
        one, other = (grids.pop(int(rng.integers(len(grids)))) for _ in range(2))
        one.merge(other)
        grids.append(one)
    assert same(grids[0], grid_of(parts))


def test_counts_saturate_in_a_merge_and_become_wide() -> None:
    rows = empty(200)
    rows["stamp_ns"], rows["distance_m"], rows["c_rr"] = START_NS, 100.0, 0.05
    rows["cov_xx_m2"] = rows["cov_yy_m2"] = 0.01
    one, other, both = (Grid(1.0, CONFIG) for _ in range(3))
    for _ in range(120):
        for grid in (one, other, both, both):
            grid.fold(rows, "loader-1")
    one.merge(other)
    assert same(one, both)
    assert max(int(at.page.votes["count"].max()) for at in both.state().pages) == 2**32 - 1


@pytest.mark.parametrize("other", [Grid(2.0, CONFIG), Grid(1.0, FoldConfig(bucket_s=60.0))])
def test_folds_of_another_kind_are_refused(other: Grid) -> None:
    with pytest.raises(ValueError, match="folded otherwise"):
        Grid(1.0, CONFIG).merge(other)
