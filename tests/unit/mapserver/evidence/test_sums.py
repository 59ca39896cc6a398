import numpy as np

from mapserver.evidence import cells as ev
from mapserver.evidence.sums import evidence
from tests.unit.mapserver.data import folded, random_samples


def test_without_first_pages_everything_is_summed():
    grid = folded(random_samples(300, 1))
    blocks = [(0, 0), (-1, -1), (40, 40)]
    sums = evidence(grid.pages(blocks))
    assert np.array_equal(sums.counts, grid.evidence(blocks).counts)
    assert not sums.changed_ns.any()
    assert not sums.counts[2].any()
    assert sums.counts.shape == (3, 256, ev.COUNTS)
    assert sums.bitmaps.shape == (3, 256, 2)
    assert sums.newest_ns.shape == sums.changed_ns.shape == sums.weight.shape == (3, 256)


def test_no_blocks_give_no_evidence():
    assert evidence([]).counts.shape == (0, 256, ev.COUNTS)
