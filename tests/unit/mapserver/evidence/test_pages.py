import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapserver.evidence import cells as ev
from mapserver.evidence.pages import CELL, CompactPages, PackedPages, Page, pick

PLACES = ev.COUNTS * ev.CELLS
counts = st.one_of(st.integers(1, 2**17), st.integers(ev.COUNT_MAX - 3, ev.COUNT_MAX))
votes = st.dictionaries(st.integers(0, PLACES - 1) | st.integers(0, 5), counts, max_size=6)
cells = st.dictionaries(
    st.integers(0, 255), st.tuples(st.integers(0, 2**64 - 1), st.integers(1, 2**62)), min_size=1, max_size=5
)
drawn = st.tuples(votes, cells)


def packed(drawn_pages: list[tuple[dict[int, int], dict[int, tuple[int, int]]]]) -> PackedPages:
    """Pages of tier 0, one for each: votes by place, and bits and stamps by cell."""
    table, all_votes, all_cells = [], [], []
    for index, (places, stamps) in enumerate(drawn_pages):
        starts = len(all_votes), len(all_cells)
        all_votes += [count << 16 | place for place, count in sorted(places.items())]
        all_cells += [(cell, bits, bits // 2, stamp_ns) for cell, (bits, stamp_ns) in sorted(stamps.items())]
        table.append((0, index, starts[0], len(all_votes), starts[1], len(all_cells)))
    return PackedPages(
        np.array(table, np.int64).reshape(-1, 6), np.array(all_votes, np.uint64), np.array(all_cells, CELL)
    )


def compact(pages: PackedPages) -> CompactPages:
    return CompactPages.from_packed(pages.table.copy(), pages.votes, pages.cells)


def page(places: dict[int, int], stamps: dict[int, tuple[int, int]] | None = None) -> Page:
    ((_, _, one),) = packed([(places, stamps or {})]).items()
    return one


def unpacked(one: Page) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    counts, bitmaps = np.zeros(PLACES, np.uint64), np.zeros((ev.CELLS, 2), np.uint64)
    newest_ns = np.zeros(ev.CELLS, np.int64)
    one.add_to(counts, bitmaps, newest_ns)
    return counts, bitmaps, newest_ns


@pytest.mark.slow
@settings(max_examples=100)
@given(st.lists(drawn, max_size=5))
def test_compact_pages_come_back_to_the_bit(drawn_pages):
    before = packed(drawn_pages)
    kept = compact(before)
    after = kept.expanded()
    assert np.array_equal(after.table, before.table)
    assert np.array_equal(after.votes, before.votes)
    assert after.cells.tobytes() == before.cells.tobytes()
    assert kept.is_sound


@given(drawn, st.sets(st.integers(0, 255)))
def test_a_part_of_the_cells_and_the_rest_are_the_page(drawn_page, chosen):
    one, inside = page(*drawn_page), np.zeros(ev.CELLS, np.bool_)
    inside[list(chosen)] = True
    part, rest = pick(one, inside), pick(one, ~inside)
    assert set(part.cells["cell"].tolist()) <= chosen
    assert not set((part.votes["place"] % ev.CELLS).tolist()) - chosen
    together = unpacked(part)
    rest.add_to(*together)
    assert all(map(np.array_equal, together, unpacked(one)))
