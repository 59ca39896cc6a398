"""The fold against the definition of the evidence, and the laws that make a grid a function of its samples."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapserver.evidence import grid as grid_module
from mapserver.evidence.fold_config import FoldConfig
from mapserver.evidence.grid import LIVE_ROWS, Grid
from mapserver.journal.history import lent
from protocol.arrays import Table
from protocol.machine.samples import empty
from tests.unit.mapserver.data import same

CONFIG = FoldConfig()
DAY_NS = 86_400 * 10**9
START_NS = 1_767_225_600 * 10**9
Batches = list[tuple[str, Table]]


def batches(seed: int, *, n: int = 150, days: float = 1.0, spread_m: float = 8.0, machines: int = 3) -> Batches:
    """Samples with everything that is hard: unknown values, unsure and tilted positions, no way driven, any order."""
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


@settings(max_examples=40)
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


@settings(max_examples=40)
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
