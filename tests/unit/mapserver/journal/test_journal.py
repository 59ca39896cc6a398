from __future__ import annotations

import random
import shutil
import sqlite3
import tempfile
from collections import Counter
from collections.abc import Iterator
from contextlib import closing, suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapserver.evidence.fold_config import name_hash
from mapserver.journal import stamp_index
from mapserver.journal.journal import UnwrittenError
from mapserver.journal.rows import LAST, Admission, MachineTotals, Progress, Selection, Watermark
from mapserver.journal.shortfall import KIND, Shortfall, SpoolShortfall, missing
from mapserver.journal.sqlite.journal import SqliteJournal
from mapserver.journal.sqlite.reader import SqliteQueries, SqliteReader
from mapserver.journal.stamp_index import StampIndex
from mapserver.journal.table_writer import meta_line
from protocol.disk.high_water_mark import mark_path
from protocol.errors import StoreError
from protocol.site.geometry import Bounds
from tests.unit.mapserver.data import NOW_NS, SITE, batch, put, random_samples, samples


def newest_ns(journal: SqliteJournal | SqliteReader) -> int:
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
)  # a bit of each field, name, samples, checksum; another record
def test_a_damaged_row_is_detected(journal, change):
    write(journal, admission(), admission(first_seq=4), admission(first_seq=7))
    if isinstance(change, int):
        record = bytearray(sql(journal, "SELECT record FROM journal WHERE row = 2")[0][0])
        record[change] ^= 1
        change = f"x'{record.hex()}'"
    sql(journal, f"UPDATE journal SET record = {change} WHERE row = 2")
    rows = journal.read()
    assert next(rows).row == 1  # earlier rows are usable
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
    """Rows of machines a, b, a, b; row i at x = 10 i .. 10 i + 4, y = -x, stamps 100 i .. 100 i + 2."""
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
    """Names of all lengths with common prefixes; machines' rows interleave."""
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


def test_a_reader_in_the_middle_holds_no_lock_on_the_log(journal, monkeypatch):
    monkeypatch.setattr("mapserver.journal.sqlite.reader.BYTES_AT_ONCE", 1)  # fewest rows at a time
    write(journal, *(admission(1, first_seq=i + 1) for i in range(300)))
    reader = SqliteReader(journal.path)
    rows = reader.read()
    next(rows)
    write(journal, admission(1, first_seq=301))
    assert sql(journal, "PRAGMA wal_checkpoint(TRUNCATE)")[0][0] == 0  # 1: busy
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
    assert journal.shrink() == 0  # free space is kept for coming rows
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


@pytest.mark.parametrize(("archived", "problem"), [("2", "what follows number 2"), ("2x", "the value '2x'")])
def test_an_archived_row_that_the_rows_do_not_follow_is_named(placed, archived, problem):
    sql(placed, f"INSERT INTO meta VALUES {meta_line('archived_row', archived)}")
    with pytest.raises(StoreError, match=rf"journal\.db: {problem} is damaged; restore"):
        placed.check()


@pytest.mark.parametrize("row", [1, 3, 4])
def test_a_row_that_is_gone_is_missed(placed, row):
    sql(placed, f"DELETE FROM journal WHERE row = {row}")
    with pytest.raises(StoreError, match=f"what follows number {row - 1} is damaged"):
        list(placed.read())
    with pytest.raises(StoreError, match=f"journal row {row} is damaged"):
        list(placed.read(selection=Selection(from_ns=1)))
    assert numbers(placed.read(until=row - 1)) == list(range(1, row))


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


S = 10**9


def append(journal: SqliteJournal, first_s: int, last_s: int) -> None:
    stamps = NOW_NS + np.array([first_s, last_s]) * S
    put(journal, batch(samples(2, stamp_ns=stamps), 1 + 2 * journal.last_row))


def inside(stretches, last: int) -> list[int]:
    return [row for first, end in stretches for row in range(first + 1, min(end, last) + 1)]


ROWS = st.lists(st.tuples(st.integers(0, 40), st.integers(0, 6)), min_size=1, max_size=25)


@pytest.mark.slow
@settings(max_examples=20, deadline=None)
@given(
    rows=ROWS, cut=st.integers(0, 25), archived=st.integers(0, 25), begin=st.integers(-1, 50), length=st.integers(0, 20)
)
def test_no_selected_row_is_passed_over(rows, cut, archived, begin, length):
    selection = Selection(NOW_NS + begin * S, NOW_NS + (begin + length) * S)
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        patch.setattr(stamp_index, "CHUNK", 4)
        journal = SqliteJournal(Path(folder) / "journal.db", SITE.name, SITE.frame)
        with closing(journal), SqliteReader(journal.path) as reader:
            index = StampIndex()
            for number, (first, more) in enumerate(rows, start=1):
                append(journal, first, first + more)
                if number == cut:
                    list(index.stretches(reader, 0, LAST, selection))
                    journal.forget(archived)
            archived_row = journal.archived_row
            for after, until in ((0, LAST), (3, 9), (8, 8), (archived_row, len(rows))):
                got = inside(index.stretches(reader, after, until, selection), len(rows))
                assert got == sorted(set(got))
                for number, (first, more) in enumerate(rows, start=1):
                    wanted = after < number <= until
                    if number <= archived_row or (first <= begin + length and first + more >= begin):
                        assert (number in got) == wanted
                    assert wanted or number not in got
            left = [(first, first + more) for first, more in rows[archived_row:]]
            next_s = min((max(first, begin) for first, last in left if last >= begin), default=None)
            expected = None if next_s is None else NOW_NS + next_s * S
            assert index.next_stamp(reader, NOW_NS + begin * S) == expected


MACHINES = ("loader-1", "loader-2")
BATCHES, SAMPLES = 10, 100  # of each machine, of each batch


def send(journal: SqliteJournal, machine: str, first_seq: int, n: int = SAMPLES, lost: int = 0) -> None:
    put(journal, batch(random_samples(n, first_seq), first_seq, machine=machine), lost=lost)


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A journal's folder after kill -9: 2000 acknowledged samples, a decision between them."""
    work, left = tmp_path_factory.mktemp("work"), tmp_path_factory.mktemp("left")
    with closing(open_journal(work)) as journal:
        for i in range(BATCHES):
            for machine in MACHINES:
                send(journal, machine, 1 + i * SAMPLES)
            if i == BATCHES // 2:
                journal.append_event("trust", NOW_NS, {"machine": "loader-2"})
        shutil.copytree(work, left, dirs_exist_ok=True)
    return left


@pytest.fixture
def folder(killed: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(killed, tmp_path / "store"))


def flip(path: Path, at: int, bit: int) -> None:
    content = bytearray(path.read_bytes())
    content[at] ^= 1 << bit
    path.write_bytes(content)


def gone_of(journal: SqliteJournal) -> dict[str, int]:
    return dict(missing([Shortfall.from_event(event) for event in journal.events(KIND)], journal.watermarks()))


def test_each_flip_in_the_log_is_named_and_counted_by_machine(killed, tmp_path):
    rng, log, counted, refusals = random.Random(1), "journal.db-wal", 0, []
    size = (killed / log).stat().st_size
    for i in range(20):
        folder = Path(shutil.copytree(killed, tmp_path / str(i)))
        flip(folder / log, rng.randrange(size), rng.randrange(8))
        try:
            journal = open_journal(folder)
        except StoreError as error:  # the file has pages of different times
            refusals.append(str(error))
            continue
        with closing(journal):
            present = {name: journal.watermark(name, 7).seq for name in MACHINES}
            assert journal.shortfall is not None
            assert gone_of(journal) == {n: BATCHES * SAMPLES - seq for n, seq in present.items() if seq < 1000}
            assert sum(gone_of(journal).values()) == 2000 - sum(len(row.rows) for row in journal.read())
            for name, n in gone_of(journal).items():
                assert f"{n} acknowledged samples of {name} are gone" in str(journal.shortfall)
            counted += 1
    assert counted > 10
    assert all("journal.db" in refusal for refusal in refusals)


def test_without_a_mark_damage_before_the_last_commit_is_named(folder):
    mark_path(folder / "journal.db").unlink()
    flip(folder / "journal.db-wal", 20_000, 3)
    with closing(open_journal(folder)) as journal:
        assert "journal.db-wal is damaged at byte" in str(journal.shortfall)


@pytest.mark.parametrize("kept", [0.0, 0.3, 0.77, 1.0])
def test_a_mark_that_is_torn_or_behind_is_no_alarm(folder, kept):
    mark = mark_path(folder / "journal.db")
    whole = mark.read_bytes()
    mark.write_bytes(whole[: int(len(whole) * kept)] + b"\x55" * 7)
    with closing(open_journal(folder)) as journal:
        assert journal.shortfall is None


def cut_short(folder: Path, share: float = 0.5) -> None:
    """As after a flip in its middle."""
    log = folder / "journal.db-wal"
    log.write_bytes(log.read_bytes()[: int(log.stat().st_size * share)])


def test_what_is_gone_is_remembered_until_it_is_sent_again_or_declared_lost(folder):
    cut_short(folder)
    with closing(open_journal(folder)) as journal:
        assert journal.shortfall is not None
        before = gone_of(journal)
        reached = {name: journal.watermark(name, 7).seq for name in MACHINES}
        assert min(before.values()) > 2 * SAMPLES
    with closing(open_journal(folder)) as journal:
        assert journal.shortfall is None, "it is named once"
        assert gone_of(journal) == before, "and counted for ever"
        send(journal, "loader-1", reached["loader-1"] + 1)  # it still has some
        assert gone_of(journal) == {**before, "loader-1": before["loader-1"] - SAMPLES}
        send(journal, "loader-1", 1001, lost=1000 - reached["loader-1"] - SAMPLES)  # and declares the others
        assert gone_of(journal) == {"loader-2": before["loader-2"]}
        assert journal.watermark("loader-1", 7).lost == before["loader-1"] - SAMPLES


def test_further_damage_of_the_log_leaves_what_was_named_before(folder, tmp_path):
    cut_short(folder)
    with closing(open_journal(folder)) as journal:
        before = gone_of(journal)
        send(journal, "loader-1", journal.watermark("loader-1", 7).seq + 1)
        again = Path(shutil.copytree(folder, tmp_path / "again"))
    cut_short(again, 0.0)
    with closing(open_journal(again)) as journal:
        assert gone_of(journal) == before


def test_decisions_that_are_gone_are_named(folder):
    cut_short(folder, 0.3)
    with closing(open_journal(folder)) as journal:
        assert journal.shortfall is not None
        assert (journal.shortfall.event, journal.shortfall.expected_event) == (0, 1)
        assert "1 events are gone" in str(journal.shortfall)


def test_a_log_with_damage_is_kept_for_a_person(folder):
    flip(folder / "journal.db-wal", 20_000, 3)
    damaged = (folder / "journal.db-wal").read_bytes()
    with closing(open_journal(folder)) as journal:
        (kept,) = folder.glob("journal.db-wal.damaged-*")
        assert kept.name.endswith(f"-{journal.shortfall.row}")
        assert kept.read_bytes() == damaged
        assert kept.stat().st_mode & 0o777 == 0o600


def test_a_journal_from_a_backup_beside_a_newer_mark_is_named(folder, tmp_path):
    with closing(open_journal(folder)) as journal:
        send(journal, "loader-1", 1001)
    shutil.copy(folder / "journal.db", tmp_path / "backup.db")
    with closing(open_journal(folder)) as journal:
        send(journal, "loader-1", 1101, n=40)
    shutil.copy(tmp_path / "backup.db", folder / "journal.db")
    with closing(open_journal(folder)) as journal:
        assert journal.shortfall == Shortfall(21, 22, 1, 1, (SpoolShortfall("loader-1", 7, 1100, 1140),))


def test_a_journal_that_is_not_there_any_more_is_named(folder):
    for name in ("journal.db", "journal.db-wal", "journal.db-shm"):
        (folder / name).unlink(missing_ok=True)
    with closing(open_journal(folder)) as journal:
        assert gone_of(journal) == dict.fromkeys(MACHINES, 1000)


def test_a_watermark_behind_its_rows_ends_the_start(folder):
    """Pages of different times: a resent batch would be taken twice."""
    with closing(open_journal(folder)) as journal:
        journal.begin()
        journal.put_watermark("loader-1", 7, Watermark(900, 0, NOW_NS))
        journal.commit()
    mark = mark_path(folder / "journal.db")
    with closing(open_journal(folder)) as journal:
        assert journal.shortfall is None
        journal._mark.write({"loader-2 " + f"{7:016x}": 1001})
    assert mark.exists()
    with pytest.raises(StoreError, match="what its write-ahead log left is damaged; restore the file from a backup"):
        open_journal(folder)
