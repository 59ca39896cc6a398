"""Maps of the past, and what is read for them."""

from contextlib import closing

import numpy as np
import pytest

from mapserver.evidence.fold_config import FoldConfig
from mapserver.journal.facts import NO_FACTS
from mapserver.past.plan import HOUR_NS
from protocol.errors import StoreError
from protocol.site.geometry import CellWindow
from tests.unit.mapserver.data import NOW_NS, random_samples, same, samples
from tests.unit.mapserver.past.past_store import PastStore, S

pytest.importorskip("pyarrow.parquet")
WINDOW = CellWindow(-7, 3, 20, 9)


@pytest.fixture(params=[0, 3, 20], ids=lambda rows: f"{rows} archived")
def store(request, tmp_path):
    """Twenty rows of two machines within half an hour, some or all of them in the archive."""
    with closing(PastStore(tmp_path)) as opened:
        parts = {name: np.split(random_samples(200, seed, half_m=25.0), 10) for seed, name in enumerate("ab")}
        for i in range(10):
            for name in "ab":
                opened.add(parts[name][i], name)
        opened.archive(request.param)
        assert opened.journal.archived_row == request.param
        yield opened


@pytest.mark.parametrize("after_s", [-1, 100, 450, 1800])
def test_a_grid_as_of_a_time_is_the_fold_of_what_was_stamped_until_then(store, after_s):
    to_ns = NOW_NS + after_s * S
    grid = store.as_of(to_ns)
    assert same(grid, store.folded(to_ns))
    assert (grid.folded > 0) == (after_s >= 0)


def test_the_stamp_itself_belongs_to_the_past(tmp_path):
    with closing(PastStore(tmp_path)) as store:
        store.add(samples(3, stamp_ns=[100, 200, 300]))
        assert [store.as_of(t).folded for t in (99, 100, 299, 300)] == [0, 1, 2, 3]


@pytest.mark.parametrize("closed_h", [None, 1, 2])
@pytest.mark.parametrize("cell_m", [0.25, 1.0, 3.0])
def test_a_window_holds_the_same_evidence_as_the_whole(tmp_path, cell_m, closed_h):
    with closing(PastStore(tmp_path, cell_m, FoldConfig(std_cap_m=2.0))) as store:
        for seed, name in enumerate("ab"):
            rows = random_samples(400, seed, half_m=80.0)
            rows["stamp_ns"] += rows["stamp_ns"] % 4 * 1200 * S
            store.add(rows, name)
        if closed_h:
            store.make(NOW_NS + closed_h * HOUR_NS)
        to_ns = NOW_NS + 2 * HOUR_NS + 900 * S
        whole, part = store.folded(to_ns), store.as_of(to_ns, window=WINDOW)
    blocks = whole.blocks_in(WINDOW)
    one, other = whole.evidence(blocks), part.evidence(blocks)
    columns = np.array([x * 16 + np.arange(256) % 16 for x, _ in blocks])
    rows = np.array([y * 16 + np.arange(256) // 16 for _, y in blocks])
    inside = (columns >= -7) & (columns < 13) & (rows >= 3) & (rows < 12)
    assert one.counts[inside].any()
    for name in ("counts", "bitmaps", "newest_ns"):
        assert np.array_equal(getattr(one, name)[inside], getattr(other, name)[inside])
    assert len(part.state().blocks) < len(whole.state().blocks), "nothing far from it is read"


# --- what is read ----------------------------------------------------------------------------------------------------


def two_hours(store: PastStore) -> None:
    """A checkpoint between two hours of one row each, and a row of the first hour that came in late."""
    store.add(samples(10, stamp_ns=NOW_NS + np.arange(10) * S))
    store.add(samples(10, stamp_ns=NOW_NS + HOUR_NS + np.arange(10) * S, x_m=100.5))
    store.make(NOW_NS + HOUR_NS)
    store.add(samples(10, stamp_ns=NOW_NS + np.arange(10) * S, x_m=200.5), "late")


@pytest.fixture
def read_rows(monkeypatch):
    """Numbers of the journal rows that are decoded."""
    from mapserver.past import past

    numbers, read = [], past.read_history

    def noted(*values):
        for rows in read(*values):
            numbers.extend(rows.numbers.tolist())
            yield rows

    monkeypatch.setattr(past, "read_history", noted)
    return numbers


def test_rows_are_read_that_a_checkpoint_lacks_and_no_others(tmp_path, read_rows):
    with closing(PastStore(tmp_path)) as store:
        two_hours(store)
        read_rows.clear()
        store.as_of(NOW_NS + HOUR_NS + S)
        assert sorted(read_rows) == [2, 3]
        read_rows.clear()
        store.as_of(NOW_NS + HOUR_NS - 1)
        assert read_rows == [3]
        read_rows.clear()
        store.as_of(NOW_NS + HOUR_NS - 2)  # before the checkpoint is closed
        assert sorted(read_rows) == [1, 3]


def test_rows_are_read_that_touch_the_window_and_no_others(tmp_path, read_rows):
    with closing(PastStore(tmp_path)) as store:
        two_hours(store)
        for x, rows in ((0, []), (100, [2]), (200, [3]), (400, [])):
            read_rows.clear()
            store.as_of(NOW_NS + HOUR_NS + 5 * S, window=CellWindow(x, 8, 1, 1))
            assert read_rows == rows


# --- damage ----------------------------------------------------------------------------------------------------------


def flip(path, at: int) -> None:
    data = bytearray(path.read_bytes())
    data[at] ^= 0x10
    path.write_bytes(data)


@pytest.mark.parametrize("at", [20, -60, -3])
def test_a_damaged_checkpoint_is_passed_over_counted_and_never_used(tmp_path, at, caplog):
    with closing(PastStore(tmp_path)) as store:
        two_hours(store)
        store.make(NOW_NS + 2 * HOUR_NS)
        flip(store.past.checkpoints.path(NOW_NS + 2 * HOUR_NS), at)
        for _ in range(2):
            assert same(store.as_of(NOW_NS + 3 * HOUR_NS), store.folded(NOW_NS + 3 * HOUR_NS))
        assert store.past.checkpoints.passed_over == 1
        assert caplog.text.count("checkpoint passed over") == 1
        assert "2026-01-01T02.checkpoint" in caplog.text
        entries = store.past.checkpoints.entries(store.past.depends_on(store.reader, NO_FACTS), 9)
        assert [entry.usable for entry in entries] == [True, False]
        store.make(NOW_NS + 2 * HOUR_NS)
        entries = store.past.checkpoints.entries(store.past.depends_on(store.reader, NO_FACTS), 9)
        assert [entry.usable for entry in entries] == [True, True]
        assert same(store.as_of(NOW_NS + 3 * HOUR_NS), store.folded(NOW_NS + 3 * HOUR_NS))


def test_what_the_archive_lost_is_an_error_also_with_a_checkpoint(tmp_path):
    with closing(PastStore(tmp_path)) as store:
        two_hours(store)
        store.archive(3)
        next((tmp_path / "archive").glob("*_000003-000003.parquet")).unlink()
        with pytest.raises(StoreError, match="the file with row 3 is missing"):
            store.as_of(NOW_NS + 2 * HOUR_NS)


def test_the_next_stamp_is_found_in_journal_and_archive(store):
    stamps = np.sort(np.concatenate([rows["stamp_ns"] for _, rows in store.sent]))
    for at in (0, NOW_NS, NOW_NS + HOUR_NS, *(stamps[::37] + 1).tolist()):
        stamp = store.past.next_stamp(store.reader, at)
        expected = stamps[stamps >= at]
        if len(expected):
            across = any(rows["stamp_ns"].min() < at <= rows["stamp_ns"].max() for _, rows in store.sent)
            assert stamp == expected[0] or (across and stamp == at)
        else:
            assert stamp is None
