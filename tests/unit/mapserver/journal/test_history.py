from collections.abc import Iterator
from pathlib import Path
from threading import Thread

import numpy as np
import pytest

from mapserver.evidence import cells as ev
from mapserver.evidence.fold_config import FoldConfig
from mapserver.evidence.grid import Grid
from mapserver.journal.archive import FOLDER, HOUR_NS, Archive, archive
from mapserver.journal.history import History, grid_as_of, history_rows, point_history, samples_of
from mapserver.journal.journal import Journal
from mapserver.journal.reader import JournalReader
from mapserver.journal.rows import Admission, JournalRow, Selection
from protocol.arrays import Table
from protocol.errors import StoreError
from protocol.site.geometry import Bounds, CellWindow
from tests.unit.mapserver.data import NOW_NS, SITE, WAIT_S, batch, folded, random_samples, same_evidence, samples

pytest.importorskip("pyarrow.parquet")
FOLD = FoldConfig()
S = 10**9
PARTS = {name: np.split(random_samples(200, seed, half_m=25.0), 10) for seed, name in enumerate("ab")}


def everything(names: str = "ab", keep: Selection | None = None) -> Grid:
    grid = Grid(1.0, FOLD)
    for name in names:
        rows = np.concatenate(PARTS[name])
        grid.fold(rows if keep is None else samples_of(JournalRow(1, name, 7, 1, rows), keep), name)
    return grid


def add(journal: Journal, rows: Table, first_seq: int, machine: str = "a", received_ns: int = NOW_NS) -> None:
    journal.begin()
    journal.append(Admission(batch(rows, first_seq, machine), 0, 0), received_ns)
    journal.commit()


@pytest.fixture(scope="module", params=[0, 3, 20], ids=lambda rows: f"{rows} archived")
def store(request, tmp_path_factory) -> Iterator[History]:
    """Twenty rows of two machines, some or all of them in the archive; nothing writes to it."""
    folder = tmp_path_factory.mktemp("store")
    journal = Journal(folder / "journal.db", SITE.name, SITE.frame)
    for i in range(10):
        for machine in "ab":
            add(journal, PARTS[machine][i], 1 + 20 * i, machine, NOW_NS + journal.last_row * HOUR_NS)
    reader = JournalReader(journal.path)
    list(archive(folder / FOLDER, reader, SITE, NOW_NS + request.param * HOUR_NS, journal.forget))
    assert journal.archived_row == request.param
    yield History.beside(reader)
    reader.close(), journal.close()


def numbers(rows: Iterator[JournalRow]) -> list[int]:
    return [row.row for row in rows]


@pytest.mark.parametrize(("after", "until"), [(0, 99), (2, 3), (3, 4), (2, 12), (9, 10), (19, 20), (20, 20), (20, 99)])
def test_archive_and_journal_are_one(store, after, until):
    assert numbers(history_rows(store, after, until)) == list(range(after + 1, min(until, 20) + 1))


def test_filters_reach_archive_and_journal(store):
    assert numbers(history_rows(store, selection=Selection(without=frozenset("a")))) == list(range(2, 21, 2))
    assert numbers(history_rows(store, selection=Selection(to_ns=NOW_NS - 1))) == []
    assert numbers(history_rows(store, selection=Selection(bounds=Bounds(100, 100, 200, 200)))) == []


@pytest.mark.parametrize("where", [0, 7, 20, 25])
def test_rows_that_move_while_they_are_read_come_once(tmp_path, where):
    """More rows than are read at once; archiving overtakes a reader that stands at any of them, twice."""
    journal = Journal(tmp_path / "journal.db", SITE.name, SITE.frame)
    journal.begin()
    for i in range(600):
        journal.append(Admission(batch(samples(1), i + 1), 0, 0), NOW_NS + i // 100 * HOUR_NS)
    journal.commit()
    reader, other = JournalReader(journal.path), JournalReader(journal.path)
    rows, read = history_rows(History.beside(reader)), []
    for i in range(2):
        read += [next(rows).row for _ in range(10 * where + 5 * i)]
        list(archive(tmp_path / FOLDER, other, SITE, NOW_NS + 3 * (i + 1) * HOUR_NS, journal.forget))
    assert read + numbers(rows) == list(range(1, 601))
    reader.close(), other.close(), journal.close()


@pytest.mark.slow
def test_rows_come_once_while_another_thread_archives_and_the_owner_writes(tmp_path):
    journal = Journal(tmp_path / "journal.db", SITE.name, SITE.frame)
    for i in range(120):
        add(journal, samples(1), i + 1, received_ns=NOW_NS + i // 10 * HOUR_NS)
    owner_calls: list[int] = []

    def age() -> None:
        mine = JournalReader(journal.path)
        list(archive(tmp_path / FOLDER, mine, SITE, NOW_NS + 8 * HOUR_NS, forget))
        mine.close()

    def forget(until: int) -> int:
        owner_calls.append(until)
        return journal.forget(until, most=3)

    thread = Thread(target=age)
    thread.start()
    while thread.is_alive():
        reader = JournalReader(journal.path)
        assert numbers(history_rows(History.beside(reader))) == list(range(1, 121))
        reader.close()
    thread.join(WAIT_S)
    assert journal.archived_row == 80
    journal.close()


def test_a_missing_file_is_no_silent_gap(tmp_path):
    journal = Journal(tmp_path / "journal.db", SITE.name, SITE.frame)
    for i in range(3):
        add(journal, samples(1), i + 1, received_ns=NOW_NS + i * HOUR_NS)
    history = History.beside(journal)
    with JournalReader(journal.path) as reader:
        list(archive(tmp_path / FOLDER, reader, SITE, NOW_NS + 2 * HOUR_NS, journal.forget))
    history.archive.paths()[1].unlink()
    with pytest.raises(StoreError, match="the file with row 2 is missing"):
        list(history_rows(history))
    journal.close()


# --- maps of the past ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("after_s", [-1, 100, 450, 1800])
def test_a_grid_as_of_a_time_is_the_fold_of_what_was_stamped_until_then(store, after_s):
    to_ns = NOW_NS + after_s * S
    grid = grid_as_of(store, to_ns, 1.0, FOLD)
    assert same_evidence(grid, everything(keep=Selection(to_ns=to_ns)))
    assert (grid.folded > 0) == (after_s >= 0)


def test_the_stamp_itself_belongs_to_the_past(tmp_path):
    journal = Journal(tmp_path / "journal.db", SITE.name, SITE.frame)
    add(journal, samples(3, stamp_ns=[100, 200, 300]), 1)
    assert [grid_as_of(History.beside(journal), t, 1.0, FOLD).folded for t in (99, 100, 299, 300)] == [0, 1, 2, 3]
    journal.close()


def test_a_grid_without_a_machine_is_that_of_the_others(store):
    assert same_evidence(grid_as_of(store, NOW_NS + 10**13, 1.0, FOLD, without=frozenset("b")), everything("a"))


@pytest.mark.parametrize("cell_m", [0.25, 1.0, 3.0])
def test_a_window_holds_the_same_evidence_as_the_whole(store, cell_m):
    config = FoldConfig(std_cap_m=2.0)
    window = CellWindow(-7, 3, 20, 9)
    whole, part = (grid_as_of(store, NOW_NS + 900 * S, cell_m, config, w) for w in (None, window))
    blocks = whole.blocks_in(window)
    one, other = whole.evidence(blocks), part.evidence(blocks)
    columns = np.array([x * 16 + np.arange(256) % 16 for x, _ in blocks])
    rows = np.array([y * 16 + np.arange(256) // 16 for _, y in blocks])
    inside = (columns >= -7) & (columns < 13) & (rows >= 3) & (rows < 12)
    assert one.counts[inside].any()
    for name in ("counts", "bitmaps", "newest_ns"):
        assert np.array_equal(getattr(one, name)[inside], getattr(other, name)[inside])
    assert part.folded + part.skipped < whole.folded + whole.skipped


def test_samples_are_chosen_by_stamp_and_place():
    row = JournalRow(1, "a", 7, 1, samples(4, stamp_ns=[10, 40, 20, 30], x_m=[0, 1, 2, 3], y_m=[3, 2, 1, 0]))

    def stamps(**wanted: object) -> list[int]:
        return samples_of(row, Selection(**wanted))["stamp_ns"].tolist()

    assert stamps(from_ns=20, to_ns=30) == [20, 30]
    assert stamps(bounds=Bounds(1, 1, 2, 3)) == [40, 20]
    assert stamps(bounds=Bounds(0, 0, 9, 0.5)) == [30]
    assert stamps(bounds=Bounds(0, 2.5, 9, 9)) == [10]
    assert stamps(bounds=Bounds(2.5, 0, 9, 9)) == [30]


# --- the history of a point ------------------------------------------------------------------------------------------


def test_the_history_of_a_cell_is_its_evidence_bucket_by_bucket(store):
    cell, span_ns = (-3, 7), 300 * S
    spans = point_history(store, cell, 1.0, FOLD)
    assert len(spans) > 2
    assert spans == sorted(spans, key=lambda span: span.first_ns)
    for span in spans:
        assert span.first_ns % span_ns == 0
        assert span.last_ns == span.first_ns + span_ns - 1
        grid = everything(keep=Selection(from_ns=span.first_ns, to_ns=span.last_ns))
        expected = grid.evidence([(-1, 0)])
        assert span.evidence.counts.shape == (1, 1, ev.COUNTS)
        assert np.array_equal(span.evidence.counts[0, 0], expected.counts[0, 16 * 7 + 13])
        assert np.array_equal(span.evidence.bitmaps[0, 0], expected.bitmaps[0, 16 * 7 + 13])
        assert span.evidence.newest_ns[0, 0] == expected.newest_ns[0, 16 * 7 + 13]
    whole = everything().evidence([(-1, 0)]).counts[0, 16 * 7 + 13]
    assert np.array_equal(sum(span.evidence.counts[0, 0] for span in spans), whole)


def test_spans_machines_and_times_of_a_history_can_be_chosen(store):
    cell, all_ns = (-3, 7), NOW_NS + 10**13
    [one] = point_history(store, cell, 1.0, FOLD, span_s=86_400.0)
    assert (one.first_ns, one.last_ns) == (NOW_NS, NOW_NS + 86_400 * S - 1)
    only_a = point_history(store, cell, 1.0, FOLD, Selection(without=frozenset("b")), span_s=86_400.0)[0]
    expected = everything("a").evidence([(-1, 0)])
    assert np.array_equal(only_a.evidence.counts[0, 0], expected.counts[0, 16 * 7 + 13])
    half = point_history(store, cell, 1.0, FOLD, Selection(from_ns=NOW_NS + 900 * S, to_ns=all_ns))
    assert half
    assert half[0].first_ns >= NOW_NS + 900 * S
    assert point_history(store, (5000, 5000), 1.0, FOLD) == []


def test_cells_are_those_of_the_grid(tmp_path):
    journal = Journal(tmp_path / "journal.db", SITE.name, SITE.frame)
    add(journal, samples(1, x_m=-0.25, y_m=20.75), 1)
    [moment] = point_history(History.beside(journal), (-1, 41), 0.5, FOLD)
    grid = folded(samples(1, x_m=-0.25, y_m=20.75), cell_m=0.5)
    assert moment.evidence.weight[0, 0] == grid.evidence([(-1, 2)]).weight[0, 9 * 16 + 15] > 0
    journal.close()


def test_an_archive_stands_beside_its_journal(tmp_path):
    journal = Journal(tmp_path / "journal.db", SITE.name, SITE.frame)
    history = History.beside(journal)
    assert (history.journal, history.archive.folder) == (journal, Path(tmp_path / FOLDER))
    assert isinstance(history.archive, Archive)
    journal.close()
