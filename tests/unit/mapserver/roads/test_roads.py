"""Roads of known lines: detection and cuts depend only on samples and facts."""

from collections import Counter
from itertools import pairwise

import numpy as np
import pytest

from mapserver.evidence.fold_config import FoldConfig
from mapserver.evidence.grid import Grid
from mapserver.roads.cutting import LATTICE_M, LEAST_M, SLIVER_M, cut
from mapserver.roads.ridges import AXES, Blur, _outstanding
from mapserver.roads.segments import SegmentTable
from mapserver.roads.skeleton import Skeletons
from protocol.arrays import Floats
from tests.unit.mapserver.roads.drives import along, grid_of, passes, ring, roads, roads_of

END_M = 3.5  # roads end this near to the turning points


def off_m(line: Floats, shown: SegmentTable) -> float:
    """Largest distance from the line's points to the roads."""
    return float(max(np.hypot(*(shown.points - place).T).min() for place in line))


def beyond_m(line: Floats, shown: SegmentTable) -> float:
    """Largest distance from the roads to the line."""
    return float(max(np.hypot(*(line - place).T).min() for place in shown.points))


def degrees(shown: SegmentTable) -> Counter[int]:
    """Number of nodes by degree."""
    return Counter(Counter(shown.nodes[shown.nodes >= 0].tolist()).values())


def same(one: SegmentTable, other: SegmentTable) -> bool:
    arrays = ("points", "ends", "ahead", "length_m", "nodes")
    return one.ids == other.ids and all(
        getattr(one, name).tobytes() == getattr(other, name).tobytes() for name in arrays
    )


def test_an_axis_is_compared_with_what_lies_across_it():
    across, turns = Blur(0.5).across, np.pi * np.arange(AXES)[:, None] / AXES  # (AXES, steps, 2) [row, column]
    steps = [step for step in range(-6, 7) if step]  # 3 m to both sides
    assert np.abs(across[..., 1] * np.cos(turns) + across[..., 0] * np.sin(turns)).max() < 1
    assert np.abs(across[..., 0] * np.cos(turns) - across[..., 1] * np.sin(turns) - steps).max() < 1


def test_an_axis_that_its_neighbour_outdoes_is_no_ridge():
    blur = Blur(1.0)
    response = np.zeros((AXES, 2 * blur.side + 1, 2 * blur.side + 1))
    for axis in range(AXES):
        for stronger in ((axis + 1) % AXES, axis - 1):
            response[:] = 0.0
            response[axis, blur.side, blur.side] = 2 * blur.least.max()
            assert outstands(response, blur)
            response[stronger, blur.side, blur.side] = 3 * blur.least.max()
            response[stronger, *(blur.side + blur.across[stronger, 0])] = 9 * blur.least.max()  # a lane beside
            assert not outstands(response, blur)


def outstands(response, blur: Blur) -> bool:
    out = np.zeros((1, 1), np.bool_)
    _outstanding(response, blur.side, blur.least, blur.across, out)
    return bool(out[0, 0])


def test_a_straight_road_is_cut_at_the_lattice():
    line = along([(10, 10), (210, 10)])
    shown = roads(passes(line))
    assert shown.ids == tuple(f"{column}_0_e" for column in range(9))
    assert off_m(line, shown) < 2.0
    assert beyond_m(line, shown) < END_M
    cuts = np.array([shown.line(i)[0, 0] for i in range(1, 9)])
    np.testing.assert_allclose(cuts % LATTICE_M, 0.5)  # first cell of the next
    assert (shown.length_m >= SLIVER_M).all()
    np.testing.assert_allclose(shown.ahead, [(1.0, 0.0)] * 9, atol=0.05)


def test_a_one_way_ring_is_closed():
    line = ring((100, 100), 40)
    shown = roads(passes(line))
    assert off_m(line, shown) < 2.0
    assert beyond_m(line, shown) < 2.0
    assert not degrees(shown)
    assert shown.length_m.sum() == pytest.approx(2 * np.pi * 40, rel=0.02)
    ends = Counter(tuple(point) for i in range(len(shown.ids)) for point in shown.line(i)[[0, -1]].tolist())
    assert set(ends.values()) == {2}  # each segment continues in another


@pytest.mark.parametrize(
    ("lines", "counts", "expected"),
    [
        ([[(20, 50), (180, 50)], [(100, 0), (100, 100)]], (60, 2), {1: 4, 4: 1}),  # a rarely driven one
        ([[(20, 50), (80, 50)], [(80, 50), (50, 50), (50, 20)], [(50, 20), (50, 80)]], (6, 6, 6), {1: 4, 4: 1}),
        ([[(20, 50), (100, 50), (180, 80)], [(20, 50), (100, 50), (180, 20)]], (6, 6), {1: 3, 3: 1}),
    ],
    ids=["crossing", "y of a loader", "fork"],
)
def test_roads_that_meet_hang_together(lines, counts, expected):
    legs = zip(lines, counts, strict=True)
    shown = roads(*(passes(along(line), count, seed=i) for i, (line, count) in enumerate(legs)))
    assert degrees(shown) == expected


@pytest.mark.parametrize(("weak", "turn"), [(3, 0.0), (3, 0.4), (10, 0.2)])
def test_lanes_six_metres_apart_stay_apart(weak, turn):
    c, s = np.cos(turn), np.sin(turn)
    there, back = (along(line) @ np.array([(c, s), (-s, c)]) for line in ([(20, 50), (180, 50)], [(180, 56), (20, 56)]))
    shown = roads(passes(there, 40), passes(back, weak, seed=1))
    assert degrees(shown) == {1: 4}
    assert off_m(np.concatenate([there, back]), shown) < 2.0
    assert beyond_m(np.concatenate([there, back]), shown) < END_M
    assert len(set(shown.ids)) == len(shown.ids)


def test_names_do_not_depend_on_what_was_made_before():
    """Tile by tile as evidence comes: earlier maps leave no trace."""
    skeletons, grid = Skeletons(1.0), Grid(1.0, FoldConfig())
    parts = [
        passes(along(line), seed=i)
        for i, line in enumerate(
            ([(-150, -20), (250, 130)], [(60, -200), (40, 300)], [(-100, 200), (300, 190)], [(300, 190), (310, -150)])
        )
    ]
    for i, part in enumerate(parts):
        grid.fold(part, f"truck-{i}")
        roads_of(grid, skeletons)
    assert same(roads_of(grid, skeletons), roads(*parts))


def test_a_tile_is_made_again_only_where_something_changed():
    skeletons, grid = Skeletons(1.0), grid_of(passes(along([(10, 10), (1990, 10)]), 1))
    roads_of(grid, skeletons)
    made = skeletons.made
    assert made >= 15
    roads_of(grid, skeletons)
    assert skeletons.made == made
    grid.fold(passes(along([(1900, 10), (1990, 10)]), 1), "truck-1")
    roads_of(grid, skeletons)
    assert made < skeletons.made <= made + 4


def test_a_road_elsewhere_renames_nothing():
    here = passes(along([(20, 20), (220, 60)]))
    alone, both = roads(here), roads(here, passes(along([(1000, 1000), (1200, 1100)])))
    assert set(alone.ids) < set(both.ids)
    for i, name in enumerate(alone.ids):
        assert both.line(both.ids.index(name)).tobytes() == alone.line(i).tobytes()


def test_halves_of_the_samples_have_the_same_names():
    line = along([(20, 30), (420, 40), (430, 240), (30, 260), (20, 30)])
    one, other = (roads(passes(line, 6, seed=seed)) for seed in (1, 2))
    kept = sum(length for name, length in zip(one.ids, one.length_m, strict=True) if name in other.ids)
    assert kept / one.length_m.sum() > 0.97


@pytest.mark.parametrize("rounds", [1, 8])
def test_a_yard_driven_all_over_gives_roads_that_are_whole(monkeypatch, rounds):
    """However early pruning ends: lines follow existing cells."""
    monkeypatch.setattr("mapserver.roads.network.ROUNDS", rounds)
    draw = np.random.default_rng(9)
    shown = roads(*(passes(along(draw.uniform(0, 80, (12, 2))), 1, seed=seed) for seed in range(4)))
    assert np.isfinite(shown.points).all()
    assert ((shown.points > -10) & (shown.points < 90)).all()
    assert (shown.length_m > 0).all()
    assert len(set(shown.ids)) == len(shown.ids)
    steps = [np.hypot(*np.diff(shown.line(i), axis=0).T).max() for i in range(len(shown.ids))]
    assert max(steps) < 8.0


def edges(*lines):
    points = np.concatenate([np.array(line, float) for line in lines])
    return points, np.cumsum([0, *map(len, lines)])


def walk(seed, count=120):
    """A slowly turning line of cell centres."""
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
