import sqlite3
from collections import Counter
from collections.abc import Iterator
from contextlib import closing, suppress
from pathlib import Path

import numpy as np
import pytest

from mapserver.evidence.fold_config import name_hash
from mapserver.journal.journal import UnwrittenError
from mapserver.journal.rows import Admission, MachineTotals, Progress, Selection, Watermark
from mapserver.journal.sqlite.journal import SqliteJournal
from mapserver.journal.sqlite.reader import SqliteQueries, SqliteReader
from mapserver.journal.table_writer import meta_line
from protocol.errors import StoreError
from protocol.site.geometry import Bounds
from tests.unit.mapserver.data import NOW_NS, SITE, batch, put, random_samples, samples


def newest_ns(journal: SqliteJournal | SqliteReader) -> int:
    """The newest stamp of all samples, archived or not."""
    return max((mark.newest_ns for mark in journal.watermarks().values()), default=0)


def open_journal(folder: Path, site: str = SITE.name, frame: str = SITE.frame) -> SqliteJournal:
    return SqliteJournal(folder / "journal.db", site, frame)


@pytest.fixture
def journal(tmp_path) -> Iterator[SqliteJournal]:
    journal = open_journal(tmp_path)
    yield journal
    with suppress(UnwrittenError):  # a test may have closed it
        journal.close()


def sql(journal: SqliteQueries, statement: str) -> list[tuple]:
    """What a statement gives on a connection of its own."""
    with closing(sqlite3.connect(journal.path, isolation_level=None)) as db:
        return db.execute(statement).fetchall()


def write(journal: SqliteJournal, *admissions: Admission) -> None:
    journal.begin()
    for admission in admissions:
        journal.append(admission, NOW_NS)
    journal.commit()


def admission(n: int = 3, first_seq: int = 1, lost: int = 0, **more) -> Admission:
    return Admission(batch(random_samples(n, first_seq), first_seq, **more), trimmed=0, lost=lost)


@pytest.mark.parametrize(
    "change", [0, 8, 16, 24, 32, 33, 40, -5, -1, "x''", "x'00'", "'text'", "5", "zeroblob(300)"]
)  # a bit of each field, the name, the samples, the checksum; another record
def test_a_damaged_row_is_detected(journal, change):
    write(journal, admission(), admission(first_seq=4), admission(first_seq=7))
    if isinstance(change, int):
        record = bytearray(sql(journal, "SELECT record FROM journal WHERE row = 2")[0][0])
        record[change] ^= 1
        change = f"x'{record.hex()}'"
    sql(journal, f"UPDATE journal SET record = {change} WHERE row = 2")
    rows = journal.read()
    assert next(rows).row == 1  # what is before it can be used
    with pytest.raises(StoreError, match=r"journal\.db: journal row 2 is damaged"):
        next(rows)
    assert [r.row for r in journal.read(after=2)] == [3]


def test_a_file_that_is_no_database_is_refused(tmp_path):
    (tmp_path / "journal.db").write_bytes(b"not a database at all" * 1000)
    with pytest.raises(StoreError, match="no usable journal"):
        open_journal(tmp_path)


def numbers(rows) -> list[int]:
    return [r.row for r in rows]


@pytest.fixture
def placed(journal):
    """Rows of machines a, b, a, b; row i lies at x = 10 i .. 10 i + 4, y = -x, with stamps 100 i .. 100 i + 2."""
    seqs = {"a": 1, "b": 1}
    for i in (1, 2, 3, 4):
        x_m, machine = 10.0 * i + np.array([0.0, 4.0, 2.0]), "ab"[(i + 1) % 2]
        rows = samples(3, x_m=x_m, y_m=-x_m, stamp_ns=100 * i + np.array([1, 0, 2]))
        write(journal, Admission(batch(rows, seqs[machine], machine), trimmed=0, lost=0))
        seqs[machine] += 3
    return journal


@pytest.mark.parametrize(
    ("selection", "expected"),
    [
        (Selection(to_ns=199), [1]),
        (Selection(to_ns=200), [1, 2]),
        (Selection(from_ns=302), [3, 4]),
        (Selection(from_ns=303), [4]),
        (Selection(without=frozenset({"a"})), [2, 4]),
        (Selection(without=frozenset({"a' OR TRUE --"})), [1, 2, 3, 4]),
        (Selection(bounds=Bounds(15, -24, 19, -20)), []),
        (Selection(bounds=Bounds(15, -24, 20, -20)), [2]),
        (Selection(bounds=Bounds(24, -50, 40, 0)), [2, 3, 4]),
        (Selection(bounds=Bounds(24.1, -50, 40, 0)), [3, 4]),
        (Selection(bounds=Bounds(0, -20, 50, 0)), [1, 2]),
        (Selection(bounds=Bounds(0, -50, 50, -34)), [3, 4]),
        (Selection(bounds=Bounds(0, -50, 50, -34.1)), [4]),
        (Selection(to_ns=350, bounds=Bounds(20, -50, 50, 0), without=frozenset({"b"})), [3]),
    ],
)
def test_reads_by_time_place_and_machine(placed, selection, expected):
    assert numbers(placed.read(selection=selection)) == expected


def test_many_rows_are_one_table(journal, monkeypatch):
    """Names of all lengths that share beginnings; a machine's rows lie between those of others."""
    monkeypatch.setattr("mapserver.journal.sqlite.reader.BYTES_AT_ONCE", 2**17)
    machines = ["a", "ab", "b", "a" * 63, "a" * 62 + "b", *(f"loader-{i}" for i in range(300))]
    drawn = np.random.default_rng(8).choice(machines, 900).tolist()
    reached = Counter()
    for i, machine in enumerate(drawn):
        rows = random_samples(1 + i % 9, seed=i)
        write(journal, Admission(batch(rows, reached[machine] + 1, machine, 2**64 - 1 - i), trimmed=0, lost=0))
        reached[machine] += len(rows)
    many = list(journal.read_many())
    assert 1 < len(many) < 20
    assert [row.machine for rows in many for row in rows] == drawn
    assert all(len(set(rows.machines)) == len(rows.machines) for rows in many)
    whole = np.concatenate([rows.samples for rows in many])
    assert whole.tobytes() == b"".join(row.rows.tobytes() for row in journal.read())
    hashes = np.repeat([np.uint64(name_hash(machine)) for machine in drawn], [1 + i % 9 for i in range(900)])
    assert (np.concatenate([rows.names() for rows in many]) == hashes).all()


def test_samples_are_selected_from_many_rows(placed):
    selection = Selection(to_ns=350, bounds=Bounds(20, -50, 33, 0), without=frozenset("b"))
    (rows,) = placed.read_many(selection=selection)
    samples, names = rows.selected(selection)
    assert samples["x_m"].tolist() == [30.0, 32.0]
    assert names.tolist() == [name_hash("a")] * 2


def test_a_reader_cannot_write(tmp_path):
    open_journal(tmp_path).close()
    reader = SqliteReader(tmp_path / "journal.db")
    with pytest.raises(sqlite3.OperationalError, match="readonly"):
        reader._db.execute("DELETE FROM journal")
    reader.close()


def test_a_reader_in_the_middle_holds_no_lock_on_the_log(journal, monkeypatch):
    monkeypatch.setattr("mapserver.journal.sqlite.reader.BYTES_AT_ONCE", 1)  # the fewest rows at a time
    write(journal, *(admission(1, first_seq=i + 1) for i in range(300)))
    reader = SqliteReader(journal.path)
    rows = reader.read()
    next(rows)
    write(journal, admission(1, first_seq=301))
    assert sql(journal, "PRAGMA wal_checkpoint(TRUNCATE)")[0][0] == 0  # 1 would be: busy
    assert len(list(rows)) == 300
    reader.close()


def test_numbers_marks_and_now_outlive_the_rows(placed):
    marks = placed.watermarks()
    assert placed.forget(99) == 4
    placed.close()
    journal = open_journal(placed.path.parent)
    assert (journal.last_row, journal.archived_row, journal.watermarks(), newest_ns(journal)) == (4, 4, marks, 402)
    write(journal, admission(1, first_seq=7))
    assert numbers(journal.read(after=4)) == [5]
    journal.close()


def test_a_journal_with_much_free_space_shrinks_in_steps(journal):
    assert journal._number("PRAGMA auto_vacuum") == 2  # incremental
    write(journal, *(admission(100, first_seq=1 + 100 * i) for i in range(200)))
    pages = journal._number("PRAGMA page_count")
    assert journal.shrink() == 0
    journal.forget(20)
    assert journal.shrink() == 0  # what is free is left for the rows to come
    journal.forget(190)
    assert journal.shrink(most_pages=50) == 50
    while journal.shrink():
        pass
    assert journal._number("PRAGMA page_count") < 0.2 * pages
    assert len(list(journal.read(190))) == 10


def test_an_event_is_never_part_of_a_group_commit(journal):
    journal.begin()
    journal.append(admission(), NOW_NS)
    with pytest.raises(UnwrittenError, match="within a transaction"):
        journal.append_event("t", 1, {})
    journal.commit()
    assert (numbers(journal.read()), journal.events()) == ([1], [])


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ("UPDATE watermark SET newest_ns = 7", "the watermark of ."),
        ("UPDATE extent SET first_stamp_ns = 1 WHERE row = 2", "the extent of journal row 2"),
        ("UPDATE extent SET west_m = 'x' WHERE row = 2", "the extent of journal row 2"),
        ("DELETE FROM extent WHERE row = 4", "what follows number 3"),
        ("UPDATE extent SET row = 9 WHERE row = 4", "the extent of journal row 9"),
        ("UPDATE events SET kind = 'u' WHERE id = 2", "event 2"),
        ("DELETE FROM events WHERE id = 1", "what follows number 0"),
        (f"INSERT INTO meta VALUES {meta_line('archived_row', '2')}", "what follows number 2"),
        (f"INSERT INTO meta VALUES {meta_line('archived_row', '2x')}", "the value '2x'"),
        ("INSERT INTO meta VALUES ('archived_row', '2', 0)", "the archived_row of the journal"),
        ("UPDATE meta SET value = '7' WHERE key = 'epoch'", "the epoch of the journal"),
        ("DELETE FROM meta WHERE key = 'frame'", "the frame of the journal"),
    ],
)
def test_what_stands_beside_the_rows_is_checked_on_opening(placed, monkeypatch, change, problem):
    monkeypatch.setattr("mapserver.journal.table_queries._EXTENTS_AT_ONCE", 3)  # read in two pieces
    for i in range(2):
        placed.append_event("t", i, {"machine": "a"})
    placed.check()
    sql(placed, change)
    for _ in range(2):  # nothing is left open by the first
        with pytest.raises(StoreError, match=rf"journal\.db: {problem} is damaged; restore"):
            placed.check()
    with pytest.raises(StoreError, match="is damaged"):
        open_journal(placed.path.parent)


@pytest.mark.parametrize("row", [1, 3, 4])
def test_a_row_that_is_gone_is_missed(placed, row):
    sql(placed, f"DELETE FROM journal WHERE row = {row}")
    with pytest.raises(StoreError, match=f"what follows number {row - 1} is damaged"):
        list(placed.read())
    with pytest.raises(StoreError, match=f"journal row {row} is damaged"):
        list(placed.read(selection=Selection(from_ns=1)))
    assert numbers(placed.read(until=row - 1)) == list(range(1, row))


def test_machines_that_are_excluded_are_not_missed(journal):
    write(journal, *(admission(1, first_seq=1 + i // 2, machine="ab"[i % 2]) for i in range(500)))
    assert numbers(journal.read(selection=Selection(without=frozenset("a")))) == list(range(2, 501, 2))
    assert numbers(journal.read(selection=Selection(without=frozenset("ab")))) == []


def test_a_new_journal_goes_on_after_an_archive(tmp_path):
    marks = {("a", 7): Watermark(50, 3, 40), ("b", 2**64 - 1): Watermark(9, 0, 60)}
    with closing(SqliteJournal(tmp_path / "journal.db", "pit", SITE.frame)) as journal:
        journal.follow_archive(20, marks)
        assert (journal.last_row, journal.archived_row, journal.watermarks()) == (20, 20, marks)
        assert journal.samples == 56
        put(journal, batch(samples(3), 51))
        journal.check()
    with closing(SqliteJournal(tmp_path / "journal.db", "pit", SITE.frame)) as again:
        assert (again.last_row, again.archived_row, again.samples, again.shortfall) == (21, 20, 59, None)


def test_totals_begin_with_what_is_on_disk():
    marks = {("a", 1): Watermark(10, 2, 5), ("a", 2): Watermark(7, 0, 3), ("b", 1): Watermark(1, 1, 0)}
    assert Progress(marks).machines() == {"a": MachineTotals(2, 15, 2, 5), "b": MachineTotals(1, 0, 1, 0)}
    assert (Progress(marks).watermark("a", 2), Progress(marks).watermark("c", 2)) == (Watermark(7, 0, 3), Watermark())
