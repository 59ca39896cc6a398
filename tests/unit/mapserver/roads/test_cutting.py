"""Lines cut at the lattice: pieces hang together, none is a sliver where it has a neighbour, nothing is lost."""

from itertools import pairwise

import numpy as np
import pytest

from mapserver.roads.cutting import LEAST_M, SLIVER_M, cut


def edges(*lines):
    points = np.concatenate([np.array(line, float) for line in lines])
    return points, np.cumsum([0, *map(len, lines)])


def walk(seed, count=120):
    """A line of cells' middles that turns slowly."""
    draw = np.random.default_rng(seed)
    heading = np.cumsum(draw.normal(0, 0.1, count)) + draw.uniform(0, 6)
    return 0.5 + np.cumsum(np.stack([np.cos(heading), np.sin(heading)], axis=1), axis=0)


@pytest.mark.parametrize("seed", range(2))
def test_pieces_share_their_ends_and_cover_the_line(seed):
    points, ends = edges(walk(seed), walk(seed + 100, 40))
    line, pieces = cut(points, ends, np.array([[1, 2], [2, 3]]))
    for edge, (first, end) in enumerate(pairwise(ends)):
        own = pieces[(pieces[:, 0] >= first) & (pieces[:, 0] < end)]
        assert (own[0, 0], own[-1, 1]) == (first, end - 1)
        np.testing.assert_array_equal(own[1:, 0], own[:-1, 1])
        np.testing.assert_array_equal(line[[first, end - 1]], points[[first, end - 1]])  # ends stay
        assert own[0, 2] == edge + 1
        assert own[-1, 3] == edge + 2
        assert (own[1:, 2] == -1).all()
        assert (own[:-1, 3] == -1).all()
        lengths = [np.hypot(*np.diff(line[a : b + 1], axis=0).T).sum() for a, b in own[:, :2]]
        assert len(own) == 1 or min(lengths) >= SLIVER_M


def test_what_is_shorter_than_a_machine_is_nothing():
    _, pieces = cut(*edges([(0.5, 0.5), (0.5 + LEAST_M - 1, 0.5)], [(50, 0), (90, 0)]), np.zeros((2, 2), np.int64))
    assert pieces[:, :2].tolist() == [[2, 3]]
