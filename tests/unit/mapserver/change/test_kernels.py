"""Kernels of the search for changes, against the same in numpy."""

import numpy as np
import pytest

from mapserver.change.kernels import differ, histograms
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
@pytest.mark.parametrize("seed", range(3))
def test_pages_differ_by_the_mean_or_the_spread_of_their_votes(seed, part):
    votes, ends, counts = made_up(seed)
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


@pytest.mark.parametrize("part", PARTS)
def test_histograms_are_those_of_the_cells_asked_for(part):
    votes, ends, counts = made_up(7)
    cells = np.array([3, 200, 17])
    columns = np.full(ev.CELLS, -1)
    columns[cells] = np.arange(3)
    out = np.zeros((4, part.stop - part.start, 3))
    histograms(votes, ends, part.start, part.stop, columns, out)
    assert np.array_equal(out, counts[:, part][:, :, cells])
