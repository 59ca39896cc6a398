import sqlite3
from collections import Counter
from collections.abc import Iterator
from contextlib import closing, suppress
from pathlib import Path

import numpy as np
import pytest

from mapserver.evidence.fold_config import name_hash
from mapserver.journal.journal import ArchivedError, UnwrittenError
from mapserver.journal.rows import ALL, Admission, Event, Selection, Watermark
from mapserver.journal.sqlite.journal import SqliteJournal
from mapserver.journal.sqlite.reader import SqliteQueries, SqliteReader
from mapserver.journal.writing import meta_line
from protocol.errors import StoreError
from protocol.site.geometry import Bounds
from tests.unit.mapserver.data import NOW_NS, SITE, batch, random_samples, samples


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


def test_commits_are_synced_to_disk(journal):
    assert journal._query("PRAGMA journal_mode") == [("wal",)]
    assert journal._number("PRAGMA synchronous") == 2  # FULL
    assert journal._number("PRAGMA journal_size_limit") == 64 * 2**20


def test_rows_read_back_bit_for_bit(journal):
    first, second = admission(5), admission(4, machine="b", spool_id=2**64 - 1)
    write(journal, first, second)
    rows = list(journal.read())
    assert [(r.row, r.machine, r.spool_id, r.first_seq) for r in rows] == [(1, "a", 7, 1), (2, "b", 2**64 - 1, 1)]
    for row, sent in zip(rows, (first, second), strict=True):
        assert row.rows.tobytes() == sent.batch.rows.tobytes()
    assert [r.row for r in journal.read(after=1)] == [2]


def test_spool_ids_beyond_signed_integers_are_kept_apart(tmp_path):
    journal = open_journal(tmp_path)
    ids = [1, 2**63 - 1, 2**63, 2**63 + 1, 2**64 - 1]
    write(journal, *(admission(i + 1, spool_id=spool) for i, spool in enumerate(ids)))
    journal.close()
    journal = open_journal(tmp_path)
    assert {spool: mark.seq for (_, spool), mark in journal.watermarks().items()} == {ids[i]: i + 1 for i in range(5)}
    journal.close()


def change_record(journal: SqliteQueries, row: int, offset: int) -> None:
    """Flip a bit."""
    record = bytearray(sql(journal, f"SELECT record FROM journal WHERE row = {row}")[0][0])
    record[offset] ^= 1
    sql(journal, f"UPDATE journal SET record = x'{record.hex()}' WHERE row = {row}")


def test_rollback_leaves_neither_row_nor_watermark(journal):
    write(journal, admission(3))
    journal.begin()
    journal.append(admission(2, first_seq=4), NOW_NS)
    journal.append(admission(2, machine="b"), NOW_NS)
    assert journal.last_row == 3
    journal.rollback()
    assert (journal.last_row, journal.watermarks()) == (1, {("a", 7): journal.watermark("a", 7)})
    assert (journal.watermark("a", 7).seq, journal.watermark("a", 7).lost) == (3, 0)
    assert [r.row for r in journal.read()] == [1]


def test_row_and_watermark_are_of_one_transaction(tmp_path):
    journal = open_journal(tmp_path)
    outside = sqlite3.connect(tmp_path / "journal.db")

    def on_disk() -> tuple[int, int]:
        count = "SELECT (SELECT COUNT(*) FROM journal), (SELECT COUNT(*) FROM watermark)"
        return outside.execute(count).fetchone()

    journal.begin()
    journal.append(admission(), NOW_NS)
    assert on_disk() == (0, 0)
    journal.commit()
    assert on_disk() == (1, 1)
    outside.close()
    journal.close()


def test_a_failed_watermark_takes_its_row_with_it(journal):
    sql(journal, "CREATE TRIGGER full BEFORE INSERT ON watermark BEGIN SELECT RAISE(FAIL, 'full'); END")
    journal.begin()
    with pytest.raises(UnwrittenError, match="full"):
        journal.append(admission(), NOW_NS)
    journal.rollback()
    assert (list(journal.read()), journal.watermarks(), journal.last_row) == ([], {}, 0)


@pytest.mark.parametrize("offset", [0, 8, 16, 24, 32, 33, 40, -5, -1])  # all fields, name, samples, checksum
def test_a_damaged_row_is_detected(journal, offset):
    write(journal, admission(), admission(first_seq=4), admission(first_seq=7))
    change_record(journal, 2, offset)
    rows = journal.read()
    assert next(rows).row == 1  # what is before it can be used
    with pytest.raises(StoreError, match=r"journal\.db: journal row 2 is damaged"):
        next(rows)
    assert [r.row for r in journal.read(after=2)] == [3]


@pytest.mark.parametrize(
    ("site", "frame", "named"), [("quarry", SITE.frame, "site 'pit'"), ("pit", "00000000", f"frame '{SITE.frame}'")]
)
def test_the_store_of_another_site_is_refused(tmp_path, site, frame, named):
    open_journal(tmp_path).close()
    with pytest.raises(StoreError, match=rf"{named}.*choose another --store"):
        open_journal(tmp_path, site, frame)


@pytest.mark.parametrize("schema", [3, 99])
def test_a_journal_of_another_schema_is_refused_with_what_to_do(tmp_path, schema):
    journal = open_journal(tmp_path)
    sql(journal, f"UPDATE meta SET value = '{schema}' WHERE key = 'schema'")
    journal.close()
    for opened in (lambda: open_journal(tmp_path), lambda: SqliteReader(journal.path)):
        with pytest.raises(StoreError, match=f"schema '{schema}', this version knows 6; open it with the version that"):
            opened()


def test_a_file_that_is_no_database_is_refused(tmp_path):
    (tmp_path / "journal.db").write_bytes(b"not a database at all" * 1000)
    with pytest.raises(StoreError, match="no usable journal"):
        open_journal(tmp_path)


def test_tables_and_their_names_are_made_in_one_transaction(tmp_path, monkeypatch):
    monkeypatch.setattr("mapserver.journal.sqlite.journal.TABLES", "CREATE TABLE meta (key, value, crc32, more); ")
    with pytest.raises(StoreError):
        open_journal(tmp_path)
    monkeypatch.undo()
    open_journal(tmp_path).close()  # nothing half-made was left behind


def test_reopening_continues_the_numbers(tmp_path):
    journal = open_journal(tmp_path)
    write(journal, admission(3), admission(2, first_seq=4))
    journal.close()
    journal = open_journal(tmp_path)
    assert (journal.last_row, journal.watermark("a", 7).seq) == (2, 5)
    write(journal, admission(2, first_seq=6))
    assert journal.last_row == 3
    journal.close()


def test_an_unknown_spool_has_no_progress(journal):
    assert journal.watermark("nobody", 1) == Watermark(0, 0)
    assert (journal.last_row, newest_ns(journal), list(journal.read())) == (0, 0, [])


def test_lost_samples_are_summed_and_kept(tmp_path):
    journal = open_journal(tmp_path)
    write(journal, admission(3, lost=0))
    write(journal, admission(2, first_seq=10, lost=6), admission(1, first_seq=13, lost=1))
    journal.close()
    journal = open_journal(tmp_path)
    watermark = journal.watermark("a", 7)
    assert (watermark.seq, watermark.lost) == (13, 7)
    journal.close()


def test_newest_stamp_is_that_of_all_rows(journal):
    for first, stamps in ((1, [50, 90, 10]), (4, [60, 20, 30])):
        write(journal, Admission(batch(samples(3, stamp_ns=stamps), first), trimmed=0, lost=0))
    assert newest_ns(journal) == 90
    assert sql(journal, "SELECT first_stamp_ns, last_stamp_ns FROM extent ORDER BY row") == [(10, 90), (20, 60)]


def test_closing_folds_the_log_into_the_file(tmp_path):
    journal = open_journal(tmp_path)
    write(journal, admission(1000))
    assert (tmp_path / "journal.db-wal").stat().st_size > 0
    journal.close()
    assert not (tmp_path / "journal.db-wal").exists()
    copy = np.frombuffer((tmp_path / "journal.db").read_bytes(), np.uint8)
    assert len(copy) > 1000 * 64


# --- reading by row, time, place and machine -------------------------------------------------------------------------


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
        (Selection(from_ns=103, to_ns=199), []),
        (Selection(without=frozenset({"a"})), [2, 4]),
        (Selection(without=frozenset({"a", "b"})), []),
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


def test_reads_by_row_numbers(placed):
    assert numbers(placed.read(after=1, until=3)) == [2, 3]
    assert numbers(placed.read(after=1, until=3, selection=Selection(to_ns=250))) == [2]
    assert numbers(placed.read(until=0)) == []


@pytest.mark.parametrize("rows", [199, 200, 201, 401])
def test_reading_in_pieces_leaves_nothing_out(journal, rows):
    write(journal, *(admission(1, first_seq=i + 1) for i in range(rows)))
    assert numbers(journal.read()) == list(range(1, rows + 1))
    assert numbers(journal.read(selection=Selection(from_ns=1))) == list(range(1, rows + 1))


def test_rows_say_when_they_were_received(placed):
    assert {r.received_ns for r in placed.read()} == {NOW_NS}


def test_opening_and_the_newest_stamp_read_no_journal_row(placed):
    tables = set()
    placed._db.set_authorizer(lambda action, table, *_: tables.add((action, table)) or sqlite3.SQLITE_OK)
    placed._return_to_disk()
    assert newest_ns(placed) == 402
    assert (sqlite3.SQLITE_READ, "watermark") in tables
    assert not tables & {(sqlite3.SQLITE_READ, name) for name in ("journal", "extent")}


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


# --- readers ---------------------------------------------------------------------------------------------------------


def test_a_reader_sees_what_is_committed(journal):
    write(journal, admission(3))
    reader = SqliteReader(journal.path)
    journal.begin()
    journal.append(admission(2, first_seq=4), NOW_NS)
    assert (numbers(reader.read()), reader.last_row, reader.watermarks()["a", 7].seq) == ([1], 1, 3)
    journal.commit()
    assert (numbers(reader.read()), reader.last_row, reader.watermarks()) == ([1, 2], 2, journal.watermarks())
    assert (reader.site, reader.frame, newest_ns(reader)) == (SITE.name, SITE.frame, newest_ns(journal))
    reader.close()


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


def test_a_reader_of_nothing_is_refused(tmp_path):
    with pytest.raises(StoreError, match="no usable journal"):
        SqliteReader(tmp_path / "journal.db")


# --- rows that are archived ------------------------------------------------------------------------------------------


def test_forgotten_rows_are_gone_and_asked_for_in_vain(placed):
    assert placed.forget(3, most=2) == 2
    assert placed.forget(3, most=2) == 3
    assert placed.forget(1) == 3  # what is gone stays gone
    assert (placed.archived_row, placed.last_row, numbers(placed.read(after=3))) == (3, 4, [4])
    for after, selection in ((0, ALL), (2, ALL), (0, Selection(from_ns=400))):
        with pytest.raises(ArchivedError, match="rows up to 3 are in the archive") as caught:
            list(placed.read(after, selection=selection))
        assert caught.value.archived_row == 3
    assert list(placed.read(after=2, until=2)) == []
    assert placed._number("SELECT COUNT(*) FROM extent") == 1


def test_numbers_marks_and_now_outlive_the_rows(placed):
    marks = placed.watermarks()
    assert placed.forget(99) == 4
    placed.close()
    journal = open_journal(placed.path.parent)
    assert (journal.last_row, journal.archived_row, journal.watermarks(), newest_ns(journal)) == (4, 4, marks, 402)
    write(journal, admission(1, first_seq=7))
    assert numbers(journal.read(after=4)) == [5]
    journal.close()


def test_forgetting_is_one_transaction(placed):
    sql(placed, "CREATE TRIGGER full BEFORE INSERT ON meta BEGIN SELECT RAISE(FAIL, 'full'); END")
    with pytest.raises(UnwrittenError, match="full"):
        placed.forget(3)
    assert (placed.archived_row, numbers(placed.read())) == (0, [1, 2, 3, 4])


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


# --- events ----------------------------------------------------------------------------------------------------------


def test_events_are_kept_in_order(tmp_path):
    journal = open_journal(tmp_path)
    bodies = [{"machine": "a", "why": "gain"}, {"cells": [1, 2]}, {"machine": "b"}]
    ids = [journal.append_event(kind, i, body) for i, (kind, body) in enumerate(zip("tct", bodies, strict=True))]
    journal.close()
    reader = SqliteReader(journal.path)
    assert [e.body for e in reader.events()] == bodies
    assert reader.events("t") == [Event(ids[0], "t", 0, bodies[0]), Event(ids[2], "t", 2, bodies[2])]
    assert [e.kind for e in reader.events(after=ids[0])] == ["c", "t"]
    reader.close()


def test_an_event_is_never_part_of_a_group_commit(journal):
    journal.begin()
    journal.append(admission(), NOW_NS)
    with pytest.raises(UnwrittenError, match="within a transaction"):
        journal.append_event("t", 1, {})
    journal.commit()
    assert (numbers(journal.read()), journal.events()) == ([1], [])


def test_an_event_that_cannot_be_numbered_leaves_no_transaction_open(journal, monkeypatch):

    def broken(query: str) -> int:
        raise StoreError(journal.path, "cannot be read: disk I/O error")

    with monkeypatch.context() as patch:
        patch.setattr(journal, "_number", broken)
        patch.setattr(journal, "_return_to_disk", lambda: None)
        with pytest.raises(StoreError, match="disk I/O error"):
            journal.append_event("t", 1, {})
    write(journal, admission(1))
    assert numbers(journal.read()) == [1]


# --- damage ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "change", ["record = x''", "record = x'00'", "record = 'text'", "record = 5", "record = zeroblob(300)"]
)
def test_a_row_that_is_not_what_was_written_is_named_and_not_read(journal, change):
    write(journal, admission(3))
    sql(journal, f"UPDATE journal SET {change} WHERE row = 1")
    with pytest.raises(StoreError, match="journal row 1 is damaged"):
        list(journal.read())


def test_a_row_under_the_number_of_another_is_named(journal):
    write(journal, admission(3), admission(3, first_seq=4), admission(3, first_seq=7))
    sql(journal, "UPDATE journal SET record = (SELECT record FROM journal WHERE row = 3) WHERE row = 2")
    with pytest.raises(StoreError, match="journal row 2 is damaged"):
        list(journal.read())


@pytest.mark.parametrize(
    "change", ["machine = 'b'", "seq = 2", "lost = 1", "newest_ns = 7", "crc32 = 1", "crc32 = '1x'"]
)
def test_a_watermark_that_is_not_what_was_written_is_named(tmp_path, change):
    journal = open_journal(tmp_path)
    write(journal, admission(3))
    sql(journal, f"UPDATE watermark SET {change}")
    journal.close()
    with pytest.raises(StoreError, match=r"the watermark of . is damaged"):
        open_journal(tmp_path)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ("UPDATE extent SET first_stamp_ns = 1 WHERE row = 2", "the extent of journal row 2"),
        ("UPDATE extent SET west_m = 'x' WHERE row = 2", "the extent of journal row 2"),
        ("UPDATE extent SET crc32 = 1 WHERE row = 2", "the extent of journal row 2"),
        ("DELETE FROM extent WHERE row = 2", "what follows number 1"),
        ("DELETE FROM extent WHERE row = 4", "what follows number 3"),
        ("UPDATE extent SET row = 9 WHERE row = 4", "the extent of journal row 9"),
        ("UPDATE events SET body = '{}' WHERE id = 1", "event 1"),
        ("UPDATE events SET kind = 'u' WHERE id = 2", "event 2"),
        ("DELETE FROM events WHERE id = 1", "what follows number 0"),
        ("DELETE FROM events WHERE id = 2", "what follows number 1"),
        (f"INSERT INTO meta VALUES {meta_line('archived_row', '2')}", "what follows number 2"),
        (f"INSERT INTO meta VALUES {meta_line('archived_row', '2x')}", "the value '2x'"),
        ("INSERT INTO meta VALUES ('archived_row', '2', 0)", "the archived_row of the journal"),
        ("UPDATE meta SET value = '7' WHERE key = 'epoch'", "the epoch of the journal"),
        ("UPDATE meta SET value = 'hill' WHERE key = 'site'", "the site of the journal"),
        ("DELETE FROM meta WHERE key = 'frame'", "the frame of the journal"),
    ],
)
def test_what_stands_beside_the_rows_is_checked_on_opening(placed, monkeypatch, change, problem):
    monkeypatch.setattr("mapserver.journal.queries._EXTENTS_AT_ONCE", 3)  # read in two pieces
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
        journal.begin()
        journal.append(Admission(batch(samples(3), 51), trimmed=0, lost=0), NOW_NS)
        journal.commit()
        journal.check()
    with closing(SqliteJournal(tmp_path / "journal.db", "pit", SITE.frame)) as again:
        assert (again.last_row, again.archived_row, again.samples, again.shortfall) == (21, 20, 59, None)
