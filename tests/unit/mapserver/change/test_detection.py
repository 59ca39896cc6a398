from dataclasses import fields, replace

import cv2
import numpy as np
import pytest

from mapserver.change.detection import (
    TUNING,
    ChangeConfig,
    Cuts,
    Known,
    credible,
    cuts,
    known,
    reach_blocks,
)
from mapserver.change.kernels import differ, likeliest_cuts, medians, sums
from mapserver.error_model import MACHINE_SHARE
from mapserver.evidence import cells as ev
from mapserver.evidence.fold_config import FoldConfig
from mapserver.evidence.grid import Grid
from mapserver.evidence.timeline import NO_PAGES, TimedPages
from protocol.arrays import Bools, Floats, Ints
from protocol.site.geometry import BLOCK_CELLS
from tests.unit.mapserver.data import NOW_NS, samples

CONFIG = ChangeConfig()
HOUR_NS = 3600 * 10**9
CENTRES = np.arange(16) + 0.5
BIN = float(np.log(ev.RESISTANCE_CENTRES[1] / ev.RESISTANCE_CENTRES[0]))


def passes(*grounds: float, column: str = "c_rr", distance_m: float = 1.0, noise: float = 0.0) -> TimedPages:
    """Pages of a block fully driven each hour, with this ground."""
    x, y = (axis.ravel() for axis in np.meshgrid(CENTRES, CENTRES))
    grid, draw = Grid(1.0, FoldConfig(keep_buckets=100)), np.random.default_rng(1)
    for hour, ground in enumerate(grounds):
        values = ground * np.exp(noise * draw.normal(size=256)) if column == "c_rr" else ground
        usual = {"x_m": x, "y_m": y, "stamp_ns": NOW_NS + hour * HOUR_NS, "distance_m": distance_m}
        grid.fold(samples(256, **usual | {column: values, "cov_xx_m2": 0, "cov_yy_m2": 0}), "a")
    return grid.pages([(0, 0)])[0]


def firsts(pages: TimedPages, config: ChangeConfig = CONFIG) -> Ints:
    return np.unique(cuts(pages, config).first)


@pytest.mark.parametrize("column", ["c_rr", "grade_e", "grade_n"])
def test_every_kind_of_vote_tells_a_change(column):
    old, new = (0.04, 0.2) if column == "c_rr" else (0.1, -0.2)
    assert firsts(passes(old, old, new, new, column=column)) == [2]


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


def bin_of(c_rr: float) -> float:
    return float(np.log(c_rr / ev.RESISTANCE_CENTRES[0])) / BIN


def test_the_kind_of_a_change_is_the_ground_after_it():
    pages = passes(0.04, 0.04, 0.2, 0.2, 0.01)
    assert np.allclose(cuts(pages, CONFIG).kind, bin_of(0.01), atol=0.6)
    assert np.isnan(cuts(passes(0.04, 0.04), CONFIG).kind).all()
    assert np.isnan(cuts(passes(0.1, -0.2, column="grade_e"), CONFIG).kind).all()


def test_a_cell_is_known_before_and_after_a_change_where_each_side_has_votes_for_a_cut():
    enough, little = {0.04: TUNING.weight_m + 0.02}, {0.04: 0.6 * TUNING.weight_m}
    for grounds, first, last in (
        ((enough, enough, enough), 0, 2),
        ((little, enough, little), 1, 1),
        ((little, little, little, little), 1, 2),
        ((enough,), 0, 0),
        ((little,), np.nan, np.nan),
    ):
        cells, pages = known(two_passes(*grounds)), two_passes(*grounds)
        begins = np.array([timed.first_ns for timed in pages], float)
        for value, index in ((cells.from_ns, first), (cells.until_ns, last)):
            assert np.array_equal(value, np.full(256, begins[index] if index == index else np.nan), equal_nan=True)
    assert np.isnan(known(NO_PAGES).from_ns).all()


def test_medians_nearer_than_bins_are_no_change():
    old = float(ev.RESISTANCE_CENTRES[8])
    assert firsts(passes(old, old * np.exp((TUNING.bins + 0.1) * BIN))) == [1]
    assert firsts(passes(old, old * np.exp((TUNING.bins - 0.1) * BIN))) == [0]


@pytest.mark.parametrize(
    ("old", "new", "change"), [(0.005, 0.0098, 0), (0.0098, 0.005, 0), (0.006, 0.0115, 1), (0.02, 0.008, 1)]
)
def test_concrete_does_not_change_by_what_zeros_of_machines_differ(old, new, change):
    assert firsts(passes(old, new)) == [change]


@pytest.mark.parametrize(("machines", "passes_each"), [(1, 1), (1, 4), (3, 1), (3, 4)])
def test_a_change_is_more_than_its_samples_state_by_machines_and_by_passes(machines, passes_each):
    old, new = ev.RESISTANCE_CENTRES[[8, 12]].tolist()
    shared = MACHINE_SHARE / machines + (1 - MACHINE_SHARE) / (machines * passes_each)
    limit = (new - old) / (TUNING.sigmas * np.sqrt(2 * shared))
    x, y = (axis.ravel() for axis in np.meshgrid(CENTRES, CENTRES))
    for std, change in ((0.9 * limit, 1), (1.1 * limit, 0)):
        grid = Grid(1.0, FoldConfig(keep_buckets=100))
        for number in range(2 * passes_each):
            ground = {"c_rr": old if number < passes_each else new, "c_rr_var": std**2}
            rows = samples(256, x_m=x, y_m=y, stamp_ns=NOW_NS + number * HOUR_NS, cov_xx_m2=0, cov_yy_m2=0, **ground)
            for machine in "abc"[:machines]:
                grid.fold(rows, machine)
        assert firsts(grid.pages([(0, 0)])[0]) == [change * passes_each]


def two_passes(*grounds: dict[float, float]) -> TimedPages:
    """Pages of a block fully driven twice; metres by ground per pass."""
    x, y = (axis.ravel() for axis in np.meshgrid(CENTRES, CENTRES))
    grid = Grid(1.0, FoldConfig())
    for hour, metres in enumerate(grounds):
        for c_rr, distance_m in metres.items():
            values = {"stamp_ns": NOW_NS + hour * HOUR_NS, "c_rr": c_rr, "distance_m": distance_m}
            grid.fold(samples(256, x_m=x, y_m=y, cov_xx_m2=0, cov_yy_m2=0, **values), "a")
    return grid.pages([(0, 0)])[0]


def test_a_cell_on_a_border_that_was_repaved_with_something_between_is_changed():
    assert firsts(two_passes({0.02: 0.55, 0.2: 0.45}, {float(np.sqrt(0.02 * 0.2)): 1.0})) == [1]


def test_histograms_that_have_more_in_common_than_variation_are_no_change():
    for moved, change in (
        (TUNING.variation + 0.05, 1),
        (TUNING.variation - 0.05, 0),
    ):  # share of the metres on other ground
        assert firsts(two_passes({0.04: 0.8, 0.2: 0.2}, {0.04: 0.8 - moved, 0.2: 0.2 + moved})) == [change]


@pytest.mark.parametrize("old_is_less", [True, False])
def test_less_evidence_than_weight_on_either_side_is_no_change(old_is_less):
    for metres, change in ((TUNING.weight_m + 0.02, 1), (TUNING.weight_m - 0.02, 0)):
        old, new = (metres, 2.0) if old_is_less else (2.0, metres)
        assert firsts(two_passes({0.04: old}, {0.2: new})) == [change]


# Ground of bin 10 in 80 x 80 cells, some changed to bin 15 at a time.
OLD, NEW, NEW_NS = 10.0, 15.0, 300e9


def believed(changed: Bools, kind: Floats, now: Floats, fresh: Bools | None = None, config: ChangeConfig = CONFIG,
             cell_m: float = 1.0) -> Bools:  # fmt: skip
    """Credible changed cells; fresh: not driven before the change."""
    cut = Cuts(changed.astype(np.int64), kind, np.where(changed, 0.0, np.nan), np.where(changed, NEW_NS, np.nan))
    from_ns = np.where(np.isnan(now), np.nan, 0.0 if fresh is None else np.where(fresh, NEW_NS, 0.0))
    return credible(cut, Known(now, from_ns, np.where(np.isnan(now), np.nan, 2 * NEW_NS)), cell_m, config)


def square(width: int, height: int | None = None, column: int = 32, row: int = 30) -> Bools:
    image: Bools = np.zeros((80, 80), np.bool_)
    image[row : row + (width if height is None else height), column : column + width] = True
    return image


def counts(changed: Bools, kind: float = NEW, beside: Bools | None = None, cell_m: float = 1.0, size_m: float = 5.0):
    """Credible part of an area changed to a kind, with old `NEW` ground beside it."""
    now: Floats = np.full(changed.shape, OLD)
    now[changed if beside is None else changed | beside] = NEW
    kinds = np.where(changed, kind, np.nan)
    return believed(changed, kinds, now, config=replace(CONFIG, size_m=size_m), cell_m=cell_m)


@pytest.mark.parametrize("edge", [1, 2, 3, 4, 5, 10])
def test_an_area_of_the_least_size_is_kept_as_it_is(edge):
    assert np.array_equal(counts(square(edge), size_m=float(edge)), square(edge))
    assert np.array_equal(counts(square(2 * edge), kind=np.nan, size_m=float(edge)), square(2 * edge))


@pytest.mark.parametrize("edge", [2, 3, 4, 5, 10])
def test_an_area_narrower_than_the_least_size_does_not_count(edge):
    for strip in (square(edge - 1, 3 * edge), square(3 * edge, edge - 1)):
        assert not counts(strip, size_m=float(edge)).any()


@pytest.mark.parametrize("width", [5, 9])
@pytest.mark.parametrize("gap", [0, 3])
def test_a_strip_of_the_kind_of_the_ground_beside_is_a_border_that_moved(width, gap):
    beside = square(20, 40, 32 + width + gap)
    strip = square(width, 40)
    assert not counts(strip, beside=beside).any()
    assert not counts(strip.T, beside=beside.T).any()
    assert np.array_equal(counts(strip), strip)  # new without that ground
    assert np.array_equal(counts(strip, beside=square(20, 40, 32 + width + 11)), strip)  # nor with it far away


def test_an_area_twice_as_wide_is_believed_beside_its_like_too():
    beside = square(20, 40, 42)
    assert np.array_equal(counts(square(10, 40), beside=beside), square(10, 40))
    assert not counts(square(9, 40), beside=beside).any()


def test_a_change_without_resistance_must_be_twice_as_wide():
    assert not counts(square(9), kind=np.nan).any()
    assert np.array_equal(counts(square(10), kind=np.nan), square(10))


def test_size_is_in_metres():
    assert counts(square(6), cell_m=1.0, size_m=3.0).any()
    assert not counts(square(6), cell_m=0.4, size_m=3.0).any()  # 8 cells; 6 are too few
    assert counts(square(1), cell_m=5.0, size_m=3.0).sum() == 1


@pytest.mark.parametrize(("row", "column"), [(0, 0), (0, 75), (75, 0), (75, 75), (20, 75)])
def test_an_area_at_the_images_border_is_kept_and_what_is_cut_by_it_is_not_guessed(row, column):
    area = square(5, 5, column, row)
    assert np.array_equal(counts(area), area)
    assert not counts(square(4, 4, min(column, 76), min(row, 76))).any()


def lane(changed: Bools, known: Bools | None = None):
    now: Floats = np.full(changed.shape, np.nan)
    now[changed] = NEW
    now[np.zeros_like(changed) if known is None else known & ~changed] = OLD
    return believed(changed, np.where(changed, NEW, np.nan), now)


@pytest.mark.parametrize("turn", [False, True])
def test_a_lane_that_changed_in_all_its_width_is_believed_where_nothing_else_is_known(turn):
    strip = square(40, 3)
    strip = strip.T if turn else strip
    assert np.array_equal(lane(strip), strip)
    corner = square(40, 3, 0, 0)
    assert np.array_equal(lane(corner.T if turn else corner), corner.T if turn else corner)
    diagonal = np.eye(80, dtype=np.bool_)
    diagonal = diagonal | np.roll(diagonal, 1, 1) | np.roll(diagonal, -1, 1) | np.roll(diagonal, 2, 1)
    diagonal[:, :2] = diagonal[:, -2:] = False
    assert lane(diagonal)[10:70].sum() == diagonal[10:70].sum()


def test_a_lane_that_moved_beside_ground_as_it_was_is_not_believed():
    strip, beside = square(40, 3, 20, 32), square(40, 1, 20, 31) | square(40, 1, 20, 35)
    assert not lane(strip, beside).any(), "known ground to both sides did not change"
    assert not lane(square(4, 3)).any(), "shorter than the least size"
    assert not lane(square(40, 2)).any(), "half of the least width"


def crop(images: Cuts | Known, part: slice):
    return type(images)(*(getattr(images, field.name)[part, part] for field in fields(images)))


@pytest.mark.parametrize("size_m", [1.0, 5.0, 6.0])
@pytest.mark.parametrize("seed", range(2))
def test_what_a_cell_shows_depends_on_the_blocks_near_it_alone(seed, size_m):
    """Queries of points and whole maps see different images but must agree."""
    rng, n = np.random.default_rng(seed), 9 * BLOCK_CELLS
    config = replace(CONFIG, size_m=size_m)
    patches = [cv2.resize(rng.random((n // edge, n // edge)), (n, n)) for edge in (3, 6, 16)]
    lanes = cv2.resize(rng.random((n // 8, 1)), (n, n)) > 0.4
    changed: Bools = np.asarray((patches[0] + patches[1] > 0.7 + 0.5 * rng.random()) & lanes)
    driven = patches[2] > 0.2
    changed &= driven
    kind = np.where(changed, 2.0 + np.rint(6 * patches[2]), np.nan)
    pages = [np.where(driven, 1e9 * np.rint(each * 3), np.nan) for each in (patches[0], 1 + patches[1])]
    seen = Known(np.where(driven & ~changed, np.rint(9 * patches[1]), np.nan), *pages)
    cut = Cuts(changed.astype(np.int64), kind, *(np.where(changed, time_ns, np.nan) for time_ns in (1e9, 2e9)))
    whole, reach = credible(cut, seen, 1.0, config), reach_blocks(1.0, config)
    middle = slice((4 - reach) * BLOCK_CELLS, (5 + reach) * BLOCK_CELLS)
    inner = slice(reach * BLOCK_CELLS, (reach + 1) * BLOCK_CELLS)
    alone = credible(crop(cut, middle), crop(seen, middle), 1.0, config)[inner, inner]
    assert np.array_equal(alone, whole[4 * BLOCK_CELLS : 5 * BLOCK_CELLS, 4 * BLOCK_CELLS : 5 * BLOCK_CELLS])


def fringed(wide: int, *, is_fresh: bool) -> tuple[Bools, Bools]:
    strip, beside = square(5, 40, 32, 20), square(wide, 40, 37, 20)
    now = np.full(strip.shape, np.nan)
    now[strip | beside] = NEW
    return strip, believed(strip, np.where(strip, NEW, np.nan), now, beside if is_fresh else None)


def test_cells_at_a_lanes_edge_that_were_first_driven_after_the_change_are_no_border_that_moved():
    strip, seen = fringed(3, is_fresh=True)
    assert np.array_equal(seen, strip)
    _, seen = fringed(3, is_fresh=False)
    assert not seen.any(), "this ground was there before, and may have moved"
    strip, seen = fringed(2, is_fresh=False)
    assert np.array_equal(seen, strip), "an edge that was driven late in the bucket in which the ground changed"


def test_wide_ground_of_the_new_kind_tells_of_a_border_even_if_it_was_driven_later():
    _, seen = fringed(5, is_fresh=True)
    assert not seen.any()


@pytest.mark.parametrize(("is_fresh", "share"), [(True, 1.0), (False, 0.0)])
def test_a_narrow_lane_is_believed_unless_cells_beside_it_stayed_as_they_were_before_and_after(is_fresh, share):
    strip, beside = square(3, 40, 32, 20), square(1, 40, 31, 20) | square(1, 40, 35, 20)
    now = np.full(strip.shape, np.nan)
    now[strip], now[beside] = NEW, OLD
    seen = believed(strip, np.where(strip, NEW, np.nan), now, beside if is_fresh else None)
    assert seen[strip].mean() == share


def test_the_rest_of_a_change_that_is_believed_is_believed_with_it_but_not_beside_ground_that_stayed():
    area, tail = square(6, 6, 20, 20), square(2, 9, 23, 26)
    unknown = np.full(area.shape, np.nan)
    both = area | tail
    now = np.where(both, NEW, unknown)
    assert np.array_equal(believed(both, np.where(both, NEW, np.nan), now), both)
    longer = area | square(2, 30, 23, 26)
    seen = believed(longer, np.where(longer, NEW, np.nan), np.where(longer, NEW, unknown))
    assert np.flatnonzero(seen.any(axis=1)).tolist() == list(range(20, 40)), (
        "a strip to row 29, and twice the least size"
    )
    now[30:, 21:27] = np.where(both, NEW, OLD)[30:, 21:27]
    seen = believed(both, np.where(both, NEW, np.nan), now)
    assert seen[area].all()
    assert seen[tail].any()
    assert not seen[30:].any()
    other = np.where(tail, NEW + 4, np.where(area, NEW, np.nan))
    assert not believed(both, other, now)[30:].any(), "another kind of ground is another change"


PARTS = [ev.RESISTANCE, ev.GRADE_EAST, ev.GRADE_NORTH]


def made_up(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Packed votes of four pages, page ends, and the counts (pages, COUNTS, 256)."""
    rng = np.random.default_rng(seed)
    counts = rng.integers(0, 5000, (4, ev.COUNTS, ev.CELLS)) * (rng.random((4, ev.COUNTS, ev.CELLS)) < 0.01)
    flat = counts.reshape(4, -1)
    packed = flat.astype(np.uint64) << np.uint64(16) | np.arange(flat.shape[1], dtype=np.uint64)
    return packed[flat > 0], np.cumsum((flat > 0).sum(axis=1)), counts


@pytest.mark.parametrize("part", PARTS)
def test_pages_differ_by_the_mean_or_the_spread_of_their_votes(part):
    votes, ends, counts = made_up(0)
    part_counts = counts[:, part].astype(float)
    bins = np.arange(part_counts.shape[1])[:, None]
    weight, first, second = (np.maximum((part_counts * bins**power).sum(axis=1), 0.0) for power in range(3))
    with np.errstate(invalid="ignore", divide="ignore"):
        mean, spread = first / weight, np.sqrt(np.maximum(second / weight - (first / weight) ** 2, 0))
    for least, most in ((0.0, 3.0), (4000.0, 6.0)):
        seen = weight > least
        low, high = (np.where(seen, (mean, spread), none) for none in (np.inf, -np.inf))
        expected = (high.max(axis=1) - low.min(axis=1)).max(axis=0) > most
        assert np.array_equal(differ(votes, ends, part.start, part.stop, least, most), expected)
        assert expected.any()
        assert not expected.all()


def entropy(votes: np.ndarray) -> np.ndarray:
    weight = votes.sum(axis=-2)
    logs = votes * np.log(np.maximum(votes, 1e-12))
    return weight * np.log(np.maximum(weight, 1e-12)) - logs.sum(axis=-2)


@pytest.mark.parametrize("seed", range(2))
def test_the_best_cut_is_the_likeliest(seed):
    rng = np.random.default_rng(seed)
    votes = rng.exponential(1.0, (7, 24, 30)) * (rng.random((7, 24, 30)) < 0.2)
    votes[4:, :, ::2] = np.roll(votes[4:, :, ::2], 6, axis=1)
    first = rng.integers(0, 3, 30)
    kept = np.where(np.arange(7)[:, None, None] >= first, votes, 0)
    until = kept.cumsum(axis=0)
    old, new = until[:-1], until[-1] - until[:-1]
    likelihood = entropy(until[-1])[None] - entropy(old) - entropy(new)
    likelihood[np.minimum(old.sum(axis=1), new.sum(axis=1)) < 1.0] = -np.inf
    best, variation, medians_before, medians_after = likeliest_cuts(votes, first, 1.0)
    known = np.isfinite(likelihood).any(axis=0)
    assert np.array_equal(best[known], likelihood.argmax(axis=0)[known] + 1)
    assert not best[~known].any()
    cells = np.flatnonzero(known)
    before, after = (part[best[cells] - 1, :, cells].T for part in (old, new))
    shares = [part / part.sum(axis=0) for part in (before, after)]
    np.testing.assert_allclose(variation[cells], np.abs(shares[0] - shares[1]).sum(axis=0) / 2, atol=1e-9)
    np.testing.assert_allclose(medians_before[cells], median(before), atol=1e-9)
    np.testing.assert_allclose(medians_after[cells], median(after), atol=1e-9)


def median(votes: np.ndarray) -> np.ndarray:
    """Median of votes (bins, cells), each bin's spread evenly around it."""
    until = np.vstack([np.zeros(votes.shape[1]), (votes / votes.sum(axis=0)).cumsum(axis=0)])
    return np.array([np.interp(0.5, column, np.arange(len(column)) - 0.5) for column in until.T])


def test_all_pages_together_have_their_sums_and_medians():
    votes, _, counts = made_up(3)
    part = ev.RESISTANCE
    together = sums(votes, part.start, part.stop)
    assert np.array_equal(together, counts[:, part].sum(axis=0))
    known = together.any(axis=0)
    of_all = medians(together)
    np.testing.assert_allclose(of_all[known], median(together[:, known]), atol=1e-9)
    assert np.isnan(medians(np.zeros((24, 2)))).all()
    assert known.any()
