from concurrent.futures import ThreadPoolExecutor
from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapserver.evidence import cells as ev
from mapserver.evidence.pages import CELL, NARROW, WIDE, Page, merge, moments, pack, pick
from tests.reference import pages as reference
from tests.unit.mapserver.data import same_page

PLACES = ev.COUNTS * ev.CELLS
counts = st.one_of(st.integers(1, 2**17), st.integers(ev.COUNT_MAX - 3, ev.COUNT_MAX))
votes = st.dictionaries(st.integers(0, PLACES - 1) | st.integers(0, 5), counts, max_size=6)
cells = st.dictionaries(st.integers(0, 255), st.tuples(st.integers(0, 2**64 - 1), st.integers(1, 2**62)), max_size=5)


def written(places: dict[int, int], stamps: dict[int, tuple[int, int]] | None = None):
    """Counts, planes, bitmaps, stamps as a kernel leaves them: every cell with a vote has a stamp, 1 if none is given.

    places: place -> count; stamps: cell -> (bits of both bitmaps, stamp).
    """
    counts, bitmaps = np.zeros(PLACES, np.uint32), np.zeros((2, ev.CELLS), np.uint64)
    newest_ns = np.zeros(ev.CELLS, np.int64)
    counts[list(places)] = list(places.values())
    newest_ns[[place % ev.CELLS for place in places]] = 1
    for cell, (bits, stamp_ns) in (stamps or {}).items():
        bitmaps[:, cell], newest_ns[cell] = (bits, bits // 2), stamp_ns
    counts = counts.reshape(ev.COUNTS, ev.CELLS)
    return counts, counts.any(axis=1), bitmaps, newest_ns


def page(places: dict[int, int], stamps: dict[int, tuple[int, int]] | None = None) -> Page:
    return pack(*written(places, stamps))


pages = st.builds(page, votes, cells)


def unpacked(one: Page) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    counts, bitmaps = np.zeros(PLACES, np.uint64), np.zeros((ev.CELLS, 2), np.uint64)
    newest_ns = np.zeros(ev.CELLS, np.int64)
    one.add_to(counts, bitmaps, newest_ns)
    return counts, bitmaps, newest_ns


@given(votes, cells)
def test_what_is_packed_is_what_was_there(places, stamps):
    counts, _, bitmaps, newest_ns = written(places, stamps)
    for packed, expected in zip(unpacked(page(places, stamps)), (counts.ravel(), bitmaps.T, newest_ns), strict=True):
        assert np.array_equal(packed, expected)


def test_packing_leaves_nothing_behind():
    for one in (pack, reference.pack):
        arrays = written({3: 7, 300: 2}, {3: (5, 9), 100: (1, 2)})
        one(*arrays)
        assert not any(array.any() for array in arrays)


def test_a_page_cannot_be_written_to():
    for one in (page({1: 5}), merge(page({1: 5}), page({2: 6}))):
        for array in (one.votes, one.cells):
            assert not array.flags.writeable


@settings(max_examples=40)
@given(votes, cells)
def test_kernel_and_reference_pack_the_same_bits(places, stamps):
    assert same_page(pack(*written(places, stamps)), reference.pack(*written(places, stamps)))


@settings(max_examples=40)
@given(pages, pages)
def test_kernel_and_reference_merge_to_the_same_bits(one, other):
    assert same_page(merge(one, other), reference.merge(one, other))


def test_every_place_of_a_full_block_is_packed():
    full = page(dict.fromkeys(range(PLACES), int(ev.COUNT_MAX)), dict.fromkeys(range(256), (2**64 - 1, 5)))
    assert full.votes["place"].tolist() == list(range(PLACES))
    assert (full.votes["count"] == ev.COUNT_MAX).all()
    assert full.cells["cell"].tolist() == list(range(256))
    assert same_page(merge(full, full), full)


def test_pages_that_were_packed_before_stay_when_the_next_are():
    """The space in which pages are packed is used again."""
    one = page({1: 5, 70_000 % PLACES: 2**20}, {1: (3, 9)})
    before = one.votes.tobytes(), one.cells.tobytes()
    page({2: 6, 9: 1}, {8: (7, 7)})
    assert (one.votes.tobytes(), one.cells.tobytes()) == before


def test_threads_pack_beside_each_other():
    def work(seed: int) -> bool:
        places = {(seed * 97 + i) % PLACES: seed * 1000 + i for i in range(1, 200)}
        expected = reference.pack(*written(places))
        return all(same_page(pack(*written(places)), expected) for _ in range(20))

    with ThreadPoolExecutor(4) as threads:
        assert all(threads.map(work, range(1, 9)))


@pytest.mark.parametrize(("count", "dtype"), [(2**16 - 1, NARROW), (2**16, WIDE), (ev.COUNT_MAX, WIDE)])
def test_counts_that_fit_take_two_bytes(count, dtype):
    one = page({3: count, 7: 1})
    assert one.votes.dtype == dtype
    assert one.votes["count"].tolist() == [count, 1]
    assert one.nbytes == 2 * dtype.itemsize + 2 * CELL.itemsize


def test_a_cell_takes_25_bytes_and_its_votes_four_each():
    assert page({0: 1, 256: 2}, {0: (1, 5)}).nbytes == CELL.itemsize + 2 * NARROW.itemsize == 25 + 8


@settings(max_examples=40)
@given(st.lists(pages, min_size=3, max_size=3))
def test_pages_merge_in_any_order_to_the_same_bits(three):
    results = [merge(merge(a, b), c) for a, b, c in permutations(three)]
    results += [merge(a, merge(b, c)) for a, b, c in permutations(three)]
    assert all(same_page(result, results[0]) for result in results)


@settings(max_examples=40)
@given(pages, pages)
def test_a_merged_page_is_the_sum_of_both_and_saturates(one, other):
    counts, bitmaps, newest_ns = unpacked(one)
    other.add_to(counts, bitmaps, newest_ns)
    expected = (np.minimum(counts, np.uint64(ev.COUNT_MAX)), bitmaps, newest_ns)
    assert all(map(np.array_equal, unpacked(merge(one, other)), expected))


def test_merging_leaves_both_pages_alone():
    one, other = page({1: 5}, {1: (1, 7)}), page({1: 6}, {1: (2, 9)})
    merge(one, other)
    assert same_page(one, page({1: 5}, {1: (1, 7)}))
    assert same_page(other, page({1: 6}, {1: (2, 9)}))


def test_a_page_that_grows_becomes_a_wide_one_and_is_the_one_that_was_packed_so():
    assert same_page(merge(page({9: 2**16 - 1}), page({9: 1})), page({9: 2**16}))


def test_nothing_merged_with_a_page_is_the_page():
    one = page({1: 5}, {1: (1, 7)})
    assert same_page(merge(one, page({})), one)
    assert same_page(merge(page({}), one), one)


@settings(max_examples=40)
@given(pages, st.sets(st.integers(0, 255)))
def test_a_part_of_the_cells_and_the_rest_are_the_page(one, chosen):
    inside = np.zeros(ev.CELLS, np.bool_)
    inside[list(chosen)] = True
    part, rest = pick(one, inside), pick(one, ~inside)
    assert set(part.cells["cell"].tolist()) <= chosen
    assert not set((part.votes["place"] % ev.CELLS).tolist()) - chosen
    assert same_page(part, reference.pick(one, inside))
    together = unpacked(part)
    rest.add_to(*together)
    assert all(map(np.array_equal, together, unpacked(one)))


def test_sums_add_many_full_pages_without_wrapping():
    counts, bitmaps, newest_ns = unpacked(page({2: ev.COUNT_MAX}))
    for _ in range(3):
        page({2: ev.COUNT_MAX}).add_to(counts, bitmaps, newest_ns)
    assert counts[2] == 4 * int(ev.COUNT_MAX)


@settings(max_examples=40)
@given(pages, st.sampled_from([ev.RESISTANCE, ev.GRADE_EAST, ev.GRADE_NORTH, ev.HEADING]))
def test_moments_are_those_of_the_histograms(one, part):
    counts = unpacked(one)[0].reshape(ev.COUNTS, ev.CELLS)[part].astype(float)
    bins = np.arange(len(counts))[:, None]
    expected = [(counts * bins**power).sum(axis=0) for power in range(3)]
    assert np.allclose(moments(one, part), expected)
    assert np.allclose(reference.moments(one, part), expected)
