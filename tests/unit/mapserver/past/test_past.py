"""Past maps, cell histories, and the rows they read."""

from contextlib import closing

import numpy as np
import pytest

from mapserver.evidence import cells as ev
from mapserver.evidence import grid as grids
from mapserver.evidence.fold_config import FoldConfig
from mapserver.journal.facts import NO_FACTS
from mapserver.journal.rows import Selection
from mapserver.past import cell_history as module
from mapserver.past.cell_history import cell_history
from protocol.site.geometry import CellWindow
from protocol.units import HOUR_NS
from tests.unit.mapserver.data import NOW_NS, folded, random_samples, same, samples
from tests.unit.mapserver.past.past_store import PastStore, S

pytest.importorskip("pyarrow.parquet")
WINDOW = CellWindow(-7, 3, 20, 9)


@pytest.fixture(params=[0, 3, 20], ids=lambda rows: f"{rows} archived")
def store(request, tmp_path):
    """Twenty rows of two machines in half an hour, some or all archived."""
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


@pytest.mark.parametrize("closed_h", [None, 2])
@pytest.mark.parametrize("cell_m", [0.25, 3.0])
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


def two_hours(store: PastStore) -> None:
    """A checkpoint between two hours of a row each, and a late row of the first hour."""
    store.add(samples(10, stamp_ns=NOW_NS + np.arange(10) * S))
    store.add(samples(10, stamp_ns=NOW_NS + HOUR_NS + np.arange(10) * S, x_m=100.5))
    store.make(NOW_NS + HOUR_NS)
    store.add(samples(10, stamp_ns=NOW_NS + np.arange(10) * S, x_m=200.5), "late")


@pytest.fixture
def read_rows(monkeypatch):
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


CELL, PLACE, BLOCK = (-3, 7), 16 * 7 + 13, (-1, 0)
SPAN_NS = 300 * S


@pytest.fixture(params=[0, 12], ids=lambda rows: f"{rows} archived")
def two_drives(request, tmp_path):
    with closing(PastStore(tmp_path)) as opened:
        parts = {name: np.split(random_samples(600, seed, half_m=15.0), 10) for seed, name in enumerate("ab")}
        for i in range(10):
            for name in "ab":
                opened.add(parts[name][i], name)
        opened.archive(request.param)
        yield opened


@pytest.mark.parametrize("piece", [7, grids.PIECE])
def test_the_history_of_a_cell_is_its_evidence_span_by_span(two_drives, monkeypatch, piece):
    monkeypatch.setattr(module, "PIECE", piece)
    past = cell_history(two_drives.past, two_drives.reader, CELL, SPAN_NS)
    assert len(past.first_ns) > 2
    assert (np.diff(past.first_ns) > 0).all()
    assert (past.first_ns % SPAN_NS == 0).all()
    assert (past.last_ns == past.first_ns + SPAN_NS - 1).all()
    assert past.evidence.counts.shape == (len(past.first_ns), 1, ev.COUNTS)
    for i, (first_ns, last_ns) in enumerate(zip(past.first_ns.tolist(), past.last_ns.tolist(), strict=True)):
        expected = two_drives.folded(last_ns, from_ns=first_ns).evidence([BLOCK])
        assert expected.weight[0, PLACE] > 0
        for name in ("counts", "bitmaps", "newest_ns", "changed_ns"):
            assert np.array_equal(getattr(past.evidence, name)[i, 0], getattr(expected, name)[0, PLACE])
    whole = two_drives.folded(NOW_NS + 10**13).evidence([BLOCK]).counts[0, PLACE]
    assert np.array_equal(past.evidence.counts.sum(axis=(0, 1)), whole)


def test_spans_machines_and_times_of_a_history_can_be_chosen(two_drives):
    day_ns = 86_400 * S
    one = cell_history(two_drives.past, two_drives.reader, CELL, day_ns)
    assert (one.first_ns.tolist(), one.last_ns.tolist()) == ([NOW_NS], [NOW_NS + day_ns - 1])
    only_a = cell_history(two_drives.past, two_drives.reader, CELL, day_ns, Selection(without=frozenset("b")))
    expected = two_drives.folded(NOW_NS + day_ns, "b").evidence([BLOCK])
    assert np.array_equal(only_a.evidence.counts[0, 0], expected.counts[0, PLACE])
    selection = Selection(from_ns=NOW_NS + 900 * S, to_ns=NOW_NS + 1499 * S)
    half = cell_history(two_drives.past, two_drives.reader, CELL, SPAN_NS, selection)
    assert half.first_ns.tolist() == [NOW_NS + 900 * S, NOW_NS + 1200 * S]
    nowhere = cell_history(two_drives.past, two_drives.reader, (5000, 5000), SPAN_NS)
    assert nowhere.first_ns.shape == (0,)
    assert nowhere.evidence.counts.shape == (0, 1, ev.COUNTS)


def test_cells_are_those_of_the_grid(tmp_path):
    with closing(PastStore(tmp_path, 0.5)) as store:
        store.add(samples(1, x_m=-0.25, y_m=20.75))
        past = cell_history(store.past, store.reader, (-1, 41), SPAN_NS)
    grid = folded(samples(1, x_m=-0.25, y_m=20.75), cell_m=0.5)
    assert past.evidence.weight[0, 0] == grid.evidence([(-1, 2)]).weight[0, 9 * 16 + 15] > 0


@pytest.mark.parametrize("std_m", [0.0, 1.0, 2.9])
def test_no_sample_is_passed_over_that_votes_for_the_cell(tmp_path, std_m):
    """Samples around the cell, 0.1 m apart, each its own span."""
    offsets = np.arange(-12.0, 12.0, 0.1)
    with closing(PastStore(tmp_path)) as store:
        stamps = NOW_NS + np.arange(len(offsets)) * S
        rows = samples(len(offsets), x_m=8.5 + offsets, stamp_ns=stamps, cov_xx_m2=std_m**2, cov_yy_m2=std_m**2)
        store.add(rows)
        past = cell_history(store.past, store.reader, (8, 8), S)
    votes = [stamp for row, stamp in zip(rows, stamps, strict=True) if _votes(row)]
    assert past.first_ns.tolist() == votes


def _votes(row) -> bool:
    evidence = folded(np.array([row])).evidence([(0, 0)])
    return bool(evidence.weight[0, 8 * 16 + 8])
