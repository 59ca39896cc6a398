import threading
from collections.abc import Iterator
from contextlib import closing
from itertools import count
from pathlib import Path

import numpy as np
import pytest

from mapserver.evidence.grid import Grid
from mapserver.journal import history as module
from mapserver.journal.archive import FOLDER, HOUR_NS, archive
from mapserver.journal.history import AHEAD, History, ahead, fold_history, history_rows
from mapserver.journal.location import JOURNAL_FILE
from mapserver.journal.rows import Admission, JournalRow, Selection
from mapserver.journal.sqlite.journal import SqliteJournal
from mapserver.journal.sqlite.reader import SqliteReader
from protocol.site.geometry import Bounds
from tests.journals import history_beside
from tests.unit.mapserver.data import (
    CONFIG,
    NOW_NS,
    SITE,
    batch,
    incoming,
    open_store,
    put,
    random_samples,
    same,
    samples,
)

pytest.importorskip("pyarrow.parquet")
PARTS = {name: np.split(random_samples(200, seed, half_m=25.0), 10) for seed, name in enumerate("ab")}


@pytest.fixture(scope="module", params=[0, 3, 20], ids=lambda rows: f"{rows} archived")
def store(request, tmp_path_factory) -> Iterator[History]:
    """Twenty rows of two machines, some or all of them in the archive; nothing writes to it."""
    folder = tmp_path_factory.mktemp("store")
    journal = SqliteJournal(folder / "journal.db", SITE.name, SITE.frame)
    for i in range(10):
        for machine in "ab":
            put(journal, batch(PARTS[machine][i], 1 + 20 * i, machine), NOW_NS + journal.last_row * HOUR_NS)
    reader = SqliteReader(journal.path)
    list(archive(folder / FOLDER, reader, SITE, NOW_NS + request.param * HOUR_NS, journal.forget))
    assert journal.archived_row == request.param
    yield history_beside(reader)
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
    journal = SqliteJournal(tmp_path / "journal.db", SITE.name, SITE.frame)
    journal.begin()
    for i in range(600):
        journal.append(Admission(batch(samples(1), i + 1), 0, 0), NOW_NS + i // 100 * HOUR_NS)
    journal.commit()
    reader, other = SqliteReader(journal.path), SqliteReader(journal.path)
    rows, read = history_rows(history_beside(reader)), []
    for i in range(2):
        read += [next(rows).row for _ in range(10 * where + 5 * i)]
        list(archive(tmp_path / FOLDER, other, SITE, NOW_NS + 3 * (i + 1) * HOUR_NS, journal.forget))
    assert read + numbers(rows) == list(range(1, 601))
    reader.close(), other.close(), journal.close()


@pytest.fixture
def history(tmp_path: Path) -> Iterator[History]:
    """Three machines, 20 rows of 25 samples each."""
    with closing(open_store(tmp_path)) as store:
        for number in range(20):
            store.commit([incoming(rows_of(name, number), 1 + 25 * number, name) for name in "abc"])
    with SqliteReader(tmp_path / JOURNAL_FILE) as reader:
        yield history_beside(reader)


def rows_of(machine: str, number: int):
    return random_samples(25, seed=100 * "abc".index(machine) + number)


def expected(machines: str) -> Grid:
    grid = Grid(SITE.cell_m, CONFIG.fold)
    for name in machines:
        for number in range(20):
            grid.fold(rows_of(name, number), name)
    return grid


@pytest.mark.parametrize("piece", [7, 16_384])
@pytest.mark.parametrize("threads", [1, 2, 3])
def test_a_history_folded_by_any_threads_is_the_fold_of_its_rows(history, monkeypatch, threads, piece):
    monkeypatch.setattr(module, "PIECE", piece)
    grid = Grid(SITE.cell_m, CONFIG.fold)
    without_b = Selection(without=frozenset("b"))
    assert fold_history(grid, history, until=30, selection=without_b, threads=threads)
    assert fold_history(grid, history, after=30, selection=without_b, threads=threads)
    assert same(grid, expected("ac"))


@pytest.mark.parametrize("threads", [1, 2])
def test_a_fold_that_is_stopped_ends_at_once_and_says_so(history, monkeypatch, threads):
    monkeypatch.setattr(module, "PIECE", 10)
    asked = count()
    grid = Grid(SITE.cell_m, CONFIG.fold)
    assert not fold_history(grid, history, stopped=lambda: next(asked) == 3, threads=threads)
    assert next(asked) == 4
    assert not [thread for thread in threading.enumerate() if thread.name.startswith(("fold", "read"))]


def test_what_is_made_ahead_comes_in_order_and_no_more_is_made_than_that():
    made = []

    def numbers() -> Iterator[int]:
        for number in count(1):
            made.append(number)
            yield number

    with closing(ahead(numbers())) as coming:
        assert [next(coming) for _ in range(50)] == list(range(1, 51))
    assert len(made) <= 50 + AHEAD
    assert list(ahead(iter(range(1, 40)))) == list(range(1, 40))


def test_an_error_of_what_is_made_ahead_comes_in_its_place():
    def numbers() -> Iterator[int]:
        yield from (1, 2)
        raise OSError("the disk")

    coming = ahead(numbers())
    assert (next(coming), next(coming)) == (1, 2)
    with pytest.raises(OSError, match="the disk"):
        next(coming)
