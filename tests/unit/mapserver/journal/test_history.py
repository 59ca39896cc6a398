from collections.abc import Iterator
from threading import Thread

import numpy as np
import pytest

from mapserver.journal.archive import FOLDER, HOUR_NS, archive
from mapserver.journal.history import History, history_rows
from mapserver.journal.rows import Admission, JournalRow, Selection
from mapserver.journal.sqlite.journal import SqliteJournal
from mapserver.journal.sqlite.reader import SqliteReader
from protocol.errors import StoreError
from protocol.site.geometry import Bounds
from tests.journals import history_beside
from tests.unit.mapserver.data import NOW_NS, SITE, WAIT_S, batch, put, random_samples, samples

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


@pytest.mark.slow
def test_rows_come_once_while_another_thread_archives_and_the_owner_writes(tmp_path):
    journal = SqliteJournal(tmp_path / "journal.db", SITE.name, SITE.frame)
    for i in range(120):
        put(journal, batch(samples(1), i + 1), NOW_NS + i // 10 * HOUR_NS)
    owner_calls: list[int] = []

    def age() -> None:
        mine = SqliteReader(journal.path)
        list(archive(tmp_path / FOLDER, mine, SITE, NOW_NS + 8 * HOUR_NS, forget))
        mine.close()

    def forget(until: int) -> int:
        owner_calls.append(until)
        return journal.forget(until, most=3)

    thread = Thread(target=age)
    thread.start()
    while thread.is_alive():
        reader = SqliteReader(journal.path)
        assert numbers(history_rows(history_beside(reader))) == list(range(1, 121))
        reader.close()
    thread.join(WAIT_S)
    assert journal.archived_row == 80
    journal.close()


def test_a_missing_file_is_no_silent_gap(tmp_path):
    journal = SqliteJournal(tmp_path / "journal.db", SITE.name, SITE.frame)
    for i in range(3):
        put(journal, batch(samples(1), i + 1), NOW_NS + i * HOUR_NS)
    history = history_beside(journal)
    with SqliteReader(journal.path) as reader:
        list(archive(tmp_path / FOLDER, reader, SITE, NOW_NS + 2 * HOUR_NS, journal.forget))
    history.archive.paths()[1].unlink()
    with pytest.raises(StoreError, match="the file with row 2 is missing"):
        list(history_rows(history))
    journal.close()
