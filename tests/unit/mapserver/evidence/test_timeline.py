import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapserver.evidence import cells as ev
from mapserver.evidence.fold_config import FoldConfig
from mapserver.evidence.pages import CELL, Page, Pages, Record, is_sound
from mapserver.evidence.settling import DAY_S, HOUR_S, Space, Tiers
from mapserver.evidence.timeline import NO_PAGES, TimedPages, Timeline, evidence, plane_counts, settle_all, timed

S = 10**9
BUCKET_S = 300
PER_HOUR, PER_DAY = HOUR_S // BUCKET_S, DAY_S // BUCKET_S
START = 1_767_225_600 // BUCKET_S  # midnight


SPACE = Space()


def page(bucket: int, weight: int = 1, cells: tuple[int, ...] = (5,)) -> Record:
    """These cells, the bucket's stamp, a vote of this weight each."""
    numbers = np.array(sorted(cells), np.uint64)
    known = np.zeros(len(cells), CELL)
    known["cell"], known["visits"], known["machines"], known["newest_ns"] = numbers, 1, 1, bucket * BUCKET_S * S + 7
    votes = np.uint64(weight) << np.uint64(16) | np.uint64(bucket % ev.COUNTS * ev.CELLS) | numbers
    return Pages(np.array([(0, bucket, 0, len(votes), 0, len(known))]), votes, known).record


FEW = Tiers.from_config(FoldConfig(keep_buckets=2, keep_hours=2, keep_days=2))


def timeline(buckets) -> Timeline:
    line = Timeline()
    for bucket in buckets:
        line.add(page(bucket))
    return line


def pages_in(line: Timeline, tiers: Tiers = FEW) -> TimedPages:
    (pages,) = timed([line], tiers, SPACE)
    return pages


def items(line: Timeline, tiers: Tiers = FEW) -> list[tuple[int, int, Page]]:
    settle_all([line], tiers, SPACE)
    return list(Pages.unpacked(line.records[0]).items())


def places(line: Timeline, tiers: Tiers = FEW) -> list[tuple[int, int]]:
    return [(tier, index) for tier, index, _ in items(line, tiers)]


def by_definition(buckets, keeps: tuple[int, int, int]) -> set[tuple[int, int]]:
    """Existing pages: the newest of each length single, older ones by the next length."""
    kept, left, spans = set(), set(buckets), (1, PER_HOUR, PER_DAY)
    for tier, (keep, span) in enumerate(zip(keeps, spans, strict=True)):
        index = {bucket: bucket // span for bucket in left}
        newest = set(sorted(set(index.values()))[-keep:])
        kept |= {(tier, i) for i in newest}
        left = {bucket for bucket in left if index[bucket] not in newest}
    return kept | ({(3, 0)} if left else set())


bucket = st.one_of(st.integers(0, 12 * PER_DAY), st.integers(0, 30)).map(lambda i: START + i)
keep = st.integers(1, 4)


@settings(max_examples=40)
@given(
    st.lists(st.tuples(bucket, st.sets(st.integers(0, 3), min_size=1).map(tuple)), min_size=1, max_size=30),
    st.tuples(keep, keep, keep),
    st.randoms(use_true_random=False),
)
def test_what_stays_apart_is_decided_cell_by_cell(driven, keeps, random):
    tiers = Tiers.from_config(FoldConfig(**dict(zip(("keep_buckets", "keep_hours", "keep_days"), keeps, strict=True))))
    line, again = Timeline(), Timeline()
    more = [line.add(page(bucket_, cells=cells)) for bucket_, cells in driven]
    assert sum(more) == line.known.bit_count() == len({cell for _, cells in driven for cell in cells})
    for cell in range(4):
        in_cell = {(tier, index) for tier, index, one in items(line, tiers) if cell in one.cells["cell"]}
        assert in_cell == by_definition([b for b, cells in driven if cell in cells], keeps)
    random.shuffle(driven)
    for bucket_, cells in driven:
        again.add(page(bucket_, cells=cells))
    settle_all([again], tiers, SPACE)
    assert line.records == again.records


def test_many_timelines_are_settled_as_each_by_itself():
    spans = [range(1), range(3), range(0, 500, 7), range(2), range(40, 0, -1)]
    alone, together = ([timeline(START + np.array(buckets)) for buckets in spans] for _ in range(2))
    for _ in range(2):  # from nothing, then beside kept pages
        settle_all(together[:-1], FEW, SPACE, least=3)
        assert [line.waiting for line in together] == [1, 0, 0, 2, 40]
        settle_all(together, FEW, SPACE)
        assert not any(line.waiting for line in together)
        for one, other in zip(alone, together, strict=True):
            settle_all([one], FEW, SPACE)
            assert one.records == other.records
        for line, buckets in zip([*alone, *together], 2 * spans, strict=True):
            for bucket_ in START + 600 + np.array(buckets):
                line.add(page(bucket_, cells=(5, 9)))


def test_blocks_of_wide_counts_are_settled_beside_others():
    lines = [Timeline() for _ in range(3)]
    for _ in range(2):
        for line, weight in zip(lines, (1, 2**15, 2), strict=True):
            line.add(page(START, weight))
    settle_all(lines, FEW, SPACE)
    assert len({len(line.records[0]) for line in lines}) == 1, "2 bytes more for large counts fill up the last 8"
    assert [items(line)[0][2].votes["count"].tolist() for line in lines] == [[2], [2**16], [4]]
    for line in lines:
        line.add(page(START))
    assert [items(line)[0][2].votes["count"].tolist() for line in lines] == [[3], [2**16 + 1], [5]]


@pytest.mark.parametrize("offset", [0, PER_HOUR - 1])
def test_spans_are_whole_buckets_hours_and_days(offset):
    buckets = [START + offset + i * PER_HOUR for i in range(4 * 24)]
    pages = list(pages_in(timeline(buckets)))
    lengths = [(one.end_ns - one.first_ns) // S for one in pages]
    assert lengths[1:] == [DAY_S, DAY_S, HOUR_S, HOUR_S, BUCKET_S, BUCKET_S]
    assert pages[0].first_ns == 0
    assert pages[0].end_ns == pages[0].page.cells["newest_ns"].max() + 1
    assert all(one.first_ns % (length * S) == 0 for one, length in zip(pages[1:], lengths[1:], strict=True))
    assert pages[-1].first_ns == buckets[-1] * BUCKET_S * S


def test_buckets_of_an_hour_are_not_cut_by_it():
    tiers = Tiers.from_config(FoldConfig(bucket_s=3600.0, keep_buckets=1, keep_hours=1, keep_days=1))
    assert places(timeline(range(500_000, 500_005)), tiers) == [(0, 500_004), (1, 500_003), (2, 500_002 // 24)]


@pytest.mark.parametrize("weight", [3, 2**16 + 5])
def test_planes_are_summed_as_all_pages_are(weight):
    line = Timeline()
    for i, bucket_ in enumerate(range(START, START + 40)):
        line.add(page(bucket_, weight + i, cells=(5, 9, 255)))
    pages = pages_in(line)
    whole = np.zeros((ev.COUNTS, ev.CELLS), np.int64)
    for one in pages:
        np.add.at(whole.reshape(-1), one.page.votes["place"], one.page.votes["count"].astype(np.int64))
    assert whole.any(axis=1).sum() == 40
    for part in (ev.HEADING, slice(0, 1), slice(0, ev.COUNTS)):
        counts, nothing = plane_counts([pages, NO_PAGES], part)
        np.testing.assert_array_equal(counts, whole[part])
        assert not nothing.any()


PLACES = ev.COUNTS * ev.CELLS
counts = st.one_of(st.integers(1, 2**17), st.integers(ev.COUNT_MAX - 3, ev.COUNT_MAX))
votes = st.dictionaries(st.integers(0, PLACES - 1) | st.integers(0, 5), counts, max_size=6)
cells = st.dictionaries(
    st.integers(0, 255), st.tuples(st.integers(0, 2**64 - 1), st.integers(1, 2**62)), min_size=1, max_size=5
)
drawn = st.tuples(votes, cells)


def packed(drawn_pages: list[tuple[dict[int, int], dict[int, tuple[int, int]]]]) -> Pages:
    table, all_votes, all_cells = [], [], []
    for index, (places, stamps) in enumerate(drawn_pages):
        starts = len(all_votes), len(all_cells)
        all_votes += [count << 16 | place for place, count in sorted(places.items())]
        all_cells += [(cell, bits, bits // 2, stamp_ns) for cell, (bits, stamp_ns) in sorted(stamps.items())]
        table.append((0, index, starts[0], len(all_votes), starts[1], len(all_cells)))
    return Pages(np.array(table, np.int64).reshape(-1, 6), np.array(all_votes, np.uint64), np.array(all_cells, CELL))


@settings(max_examples=15)
@given(st.lists(drawn, max_size=5))
def test_pages_come_back_from_their_record_to_the_bit(drawn_pages):
    before = packed(drawn_pages)
    record = before.record
    after = Pages.unpacked(record)
    assert np.array_equal(after.table, before.table)
    assert np.array_equal(after.votes, before.votes)
    assert after.cells.tobytes() == before.cells.tobytes()
    assert is_sound(record)


def summed(pages: TimedPages, start: np.ndarray) -> tuple[np.ndarray, ...]:
    """A block's counts, bitmaps and newest stamps by page, like `evidence`."""
    counts, bitmaps = np.zeros((256, ev.COUNTS), np.uint64), np.zeros((256, 2), np.uint64)
    newest_ns = np.zeros(256, np.int64)
    for index, one in enumerate(pages):
        plane, cell = np.divmod(one.page.votes["place"].astype(int), 256)
        holds = start[cell] <= index
        np.add.at(counts, (cell[holds], plane[holds]), one.page.votes["count"][holds].astype(np.uint64))
        cells = one.page.cells[start[one.page.cells["cell"]] <= index]
        bitmaps[cells["cell"]] |= np.stack([cells["visits"], cells["machines"]], axis=1)
        newest_ns[cells["cell"]] = np.maximum(newest_ns[cells["cell"]], cells["newest_ns"])
    return counts, bitmaps, newest_ns


@settings(max_examples=15)
@given(st.lists(st.lists(drawn, max_size=6), min_size=1, max_size=3), st.randoms(use_true_random=False))
def test_evidence_is_the_sum_of_the_pages_that_hold(drawn_blocks, random):
    draw = np.random.default_rng(random.getrandbits(32))
    blocks = []
    for drawn_pages in drawn_blocks:
        pages = packed(drawn_pages)
        tiers = np.sort(draw.integers(0, 4, len(drawn_pages)))
        pages.table[:, 0] = tiers
        blocks.append(TimedPages(pages.record, FEW))
    start = [draw.integers(0, 1 + len(pages), 256) for pages in blocks]
    sums = evidence(blocks, start)
    for i, pages in enumerate(blocks):
        assert all(map(np.array_equal, (sums.counts[i], sums.bitmaps[i], sums.newest_ns[i]), summed(pages, start[i])))
        votes, ends = pages.packed_votes()
        parts = np.split(votes, ends[:-1]) if len(ends) else []
        for part, one in zip(parts, pages, strict=True):
            assert (part & np.uint64(0xFFFF)).tolist() == one.page.votes["place"].tolist()
            assert (part >> np.uint64(16)).tolist() == one.page.votes["count"].tolist()
        for count in range(len(pages) + 1):
            some = zip(pages.older(count), pages, strict=False)
            assert len(pages.older(count)) == count
            assert all(bits(a.page) == bits(b.page) for a, b in some)


def bits(one: Page) -> tuple[list, list, bytes]:
    return one.votes["place"].tolist(), one.votes["count"].tolist(), one.cells.tobytes()
