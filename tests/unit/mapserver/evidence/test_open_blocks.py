import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapserver.evidence import cells as ev
from mapserver.evidence.fold import _find
from mapserver.evidence.open_blocks import CODE_HALF, FREE, NoRoom, OpenBlocks, code_of, split_code
from mapserver.evidence.votes import HASH

MINUTES_TO_2100 = 4_102_444_800 // 60
corner = st.integers(-CODE_HALF, CODE_HALF - 1)


def slots_found(blocks: OpenBlocks, codes: list[int]) -> list[int]:
    """Slots as a kernel finds them."""
    return [int(_find(blocks.keys, blocks.places, blocks.shift, code)) for code in codes]


def codes_beginning_at(blocks: OpenBlocks, entry: int, n: int) -> list[int]:
    """Codes whose search begins at one entry of the table."""
    mask = 2**64 - 1
    return [c for c in range(1, 100_000) if ((c * HASH) & mask) >> blocks.shift == entry][:n]


@given(st.integers(0, MINUTES_TO_2100), corner, corner)
def test_a_code_says_bucket_column_and_row(bucket, x, y):
    code = int(code_of(np.int64(bucket), np.int64(x), np.int64(y)))
    assert split_code(code) == (bucket, x, y)
    assert 0 <= code < 2**63


def test_codes_of_neighbours_differ_where_the_sign_does():
    places = [(b, x, y) for b in (0, 1) for x in (-2, -1, 0, 1) for y in (-2, -1, 0, 1)]
    assert len({int(code_of(*map(np.int64, place))) for place in places}) == len(places)


@pytest.mark.parametrize("slots", [1, 2, 3, 7, 8, 512])
def test_a_full_table_finds_every_block_and_no_other(slots):
    blocks = OpenBlocks(slots)
    codes = [int(code_of(np.int64(9), np.int64(i % 23 - 11), np.int64(-i))) for i in range(slots)]
    blocks.open(codes)
    with pytest.raises(NoRoom) as caught:
        blocks.open([-2])
    assert caught.value.blocks == 1
    assert len(blocks) == slots
    assert slots_found(blocks, codes) == blocks.slots_of(codes).tolist() == list(range(slots))
    others = [code + (1 << 36) for code in codes]
    assert slots_found(blocks, others) == blocks.slots_of(others).tolist() == [FREE] * slots
    assert (blocks.keys == FREE).sum() >= slots  # so that a search ends


@pytest.mark.parametrize("slots", [1, 4, 100])
def test_a_search_wraps_around_the_end_of_the_table(slots):
    blocks = OpenBlocks(slots)
    last = len(blocks.keys) - 1
    codes = codes_beginning_at(blocks, last, slots + 1)
    blocks.open(codes[:-1])
    assert slots_found(blocks, codes) == [*range(slots), FREE]
    assert blocks.keys[last] == codes[0]
    if slots > 1:
        assert blocks.keys[0] == codes[1]


def test_more_blocks_than_there_is_room_for_open_none():
    blocks = OpenBlocks(3)
    blocks.open([1])
    with pytest.raises(NoRoom) as caught:
        blocks.open([2, 3, 4])
    assert caught.value.blocks == 3
    assert len(blocks) == 1
    assert slots_found(blocks, [1, 2, 3, 4]) == [0, FREE, FREE, FREE]
    blocks.open([2, 3])
    assert slots_found(blocks, [1, 2, 3]) == [0, 1, 2]


def test_draining_gives_what_was_written_and_forgets_it():
    blocks = OpenBlocks(3)
    blocks.open([11, 22, 33])
    slot = blocks.slots_of([22])[0]
    blocks.planes[slot, 5] = True
    blocks.counts[slot, 5, 7], blocks.newest[slot, 7], blocks.bitmaps[slot, 1, 7], blocks.load = 9, 1000, 3, 9
    (code, page), *more = blocks.drain()
    assert (code, more) == (22, [])  # blocks in which nothing was written are not in it
    assert page.votes.tolist() == [(5 * ev.CELLS + 7, 9)]
    assert page.cells["newest_ns"].tolist() == [1000]
    assert page.cells[["visits", "machines"]].tolist() == [(0, 3)]
    assert (len(blocks), blocks.load) == (0, 0)
    assert slots_found(blocks, [11, 22, 33]) == [FREE] * 3
    assert not any(array.any() for array in (blocks.counts, blocks.planes, blocks.bitmaps, blocks.newest))


def test_blocks_open_in_later_rounds_are_empty():
    blocks = OpenBlocks(2)
    for round_ in range(3):
        blocks.open([round_, round_ + 100])
        assert not blocks.counts.any()
        blocks.planes[:, 0] = True
        blocks.counts[:, 0, 0], blocks.newest[:, 0] = 1 + round_, 1
        pages = dict(blocks.drain())
        assert {code: int(page.votes["count"][0]) for code, page in pages.items()} == {
            round_: 1 + round_,
            round_ + 100: 1 + round_,
        }
