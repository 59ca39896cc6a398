"""Kernels of the search for changes, against the same in numpy."""

import numpy as np
import pytest

from mapserver.change.kernels import differ, likeliest_cuts, medians, sums
from mapserver.evidence import cells as ev

PARTS = [ev.RESISTANCE, ev.GRADE_EAST, ev.GRADE_NORTH]


def made_up(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Votes of four pages packed, where each page's end, and the same as counts (pages, COUNTS, 256)."""
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
    """Weight times entropy of histograms (..., bins, cells)."""
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
    """Where half of the votes (bins, cells) lie below, each bin's spread evenly around it."""
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
