import os
import sqlite3
import stat
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import asdict, replace
from itertools import chain, count
from pathlib import Path

import numpy as np
import pytest

from mapserver.evidence.grid import Grid
from mapserver.journal import archive as ar
from mapserver.journal import archive_file
from mapserver.journal import history as module
from mapserver.journal.archive import FOLDER, Archive, archive, next_file
from mapserver.journal.archive_file import ArchiveFile
from mapserver.journal.history import History, ahead, fold_history, history_rows
from mapserver.journal.location import JOURNAL_FILE
from mapserver.journal.records import record
from mapserver.journal.rows import ALL, LAST, Admission, JournalRow, Selection
from mapserver.journal.sqlite.journal import SqliteJournal
from mapserver.journal.sqlite.reader import SqliteReader
from protocol import files
from protocol.errors import ConfigError, StoreError
from protocol.site.geometry import Bounds
from protocol.site.site_config import KnownGround
from protocol.units import HOUR_NS
from tests.journals import history_beside
from tests.unit.mapserver.data import CONFIG, NOW_NS, SITE, batch, put, random_samples, same, samples

pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")
PARTS = {name: np.split(random_samples(200, seed, half_m=25.0), 10) for seed, name in enumerate("ab")}


@pytest.fixture(scope="module", params=[0, 3, 20], ids=lambda rows: f"{rows} archived")
def store(request, tmp_path_factory) -> Iterator[History]:
    """Twenty rows of two machines, some or all archived; never written to."""
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


@pytest.mark.parametrize("where", [0, 7, 20, 25])
def test_rows_that_move_while_they_are_read_come_once(tmp_path, where):
    """More rows than one read; archiving overtakes the reader twice, at any of them."""
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
    with closing(SqliteJournal(tmp_path / JOURNAL_FILE, SITE.name, SITE.frame)) as journal:
        for number in range(20):
            for name in "abc":
                put(journal, batch(rows_of(name, number), 1 + 25 * number, name))
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


def test_an_error_of_what_is_made_ahead_comes_in_its_place():
    def numbers() -> Iterator[int]:
        yield from (1, 2)
        raise OSError("the disk")

    coming = ahead(numbers())
    assert (next(coming), next(coming)) == (1, 2)
    with pytest.raises(OSError, match="the disk"):
        next(coming)


FUTURE = NOW_NS + 1000 * HOUR_NS


class Machines:
    def __init__(self, folder: Path) -> None:
        self.journal = SqliteJournal(folder / "journal.db", SITE.name, SITE.frame)
        self.reader = SqliteReader(folder / "journal.db")
        self.folder = folder / ar.FOLDER
        self._next: dict[str, int] = {}

    def send(self, n: int, received_ns: int, machine: str = "a", spool_id: int = 7, seed: int = 0) -> None:
        first = self._next.get(machine, 1)
        rows = random_samples(n, 100 * seed + self.journal.last_row)
        put(self.journal, batch(rows, first, machine, spool_id), received_ns)
        self._next[machine] = first + n

    def archive(
        self, before_ns: int = FUTURE, forget: Callable[[int], int] | None = None, now_ns: int = LAST
    ) -> list[str]:
        made = archive(self.folder, self.reader, SITE, before_ns, forget or self.journal.forget, now_ns)
        return [path.name for path in made]

    def both(self, selection: Selection = ALL) -> list[tuple]:
        until = self.journal.archived_row
        return plain([*archived(self.folder, 0, until, selection), *self.reader.read(until, selection=selection)])

    def close(self) -> None:
        self.reader.close()
        self.journal.close()


def archived(folder: Path, after: int, until: int, selection: Selection = ALL) -> Iterator[JournalRow]:
    return chain.from_iterable(Archive(folder).read_many(after, until, selection))


def plain(rows: list[JournalRow] | Iterator[JournalRow]) -> list[tuple]:
    return [(r.row, r.machine, r.spool_id, r.first_seq, r.received_ns, r.rows.tobytes()) for r in rows]


@contextmanager
def opened(folder: Path) -> Iterator[Machines]:
    machines = Machines(folder)
    yield machines
    machines.close()


@pytest.fixture
def day(tmp_path) -> Iterator[Machines]:
    with opened(tmp_path) as machines:
        for i, (machine, spool) in enumerate(zip("aabcaba", (7, 7, 2**64 - 1, 3, 7, 2**64 - 1, 7), strict=True)):
            machines.send(5 + i, NOW_NS + i // 3 * HOUR_NS + i, machine, spool)
        yield machines


def test_each_hour_of_reception_is_a_file(day):
    before = plain(day.reader.read())
    assert day.archive() == [
        "2026-01-01T00_000001-000003.parquet",
        "2026-01-01T01_000004-000006.parquet",
        "2026-01-01T02_000007-000007.parquet",
    ]
    assert day.both() == before
    assert day.journal.archived_row == 7
    assert day.journal._number("SELECT COUNT(*) FROM journal") == 0


@pytest.mark.parametrize(("hours", "archived"), [(0.99, 0), (1.0, 3), (1.99, 3), (2.0, 6), (3.0, 7)])
def test_an_hour_is_archived_once_it_ended_before_the_given_time(day, hours, archived):
    day.archive(NOW_NS + int(hours * HOUR_NS))
    assert day.journal.archived_row == archived


def test_a_full_hour_is_cut_and_row_groups_never_cut_a_batch(tmp_path, monkeypatch):
    monkeypatch.setattr(ar, "FILE_SAMPLES", 12)
    monkeypatch.setattr(ar, "GROUP_SAMPLES", 6)
    with opened(tmp_path) as machines:
        for _ in range(7):
            machines.send(4, NOW_NS)
        before = machines.both()
        assert [name[14:27] for name in machines.archive()] == ["000001-000003", "000004-000006", "000007-000007"]
        files = Archive(machines.folder).paths()
        assert [pq.ParquetFile(path).metadata.num_row_groups for path in files] == [2, 2, 1]
        assert machines.both() == before


def test_a_file_stands_for_itself(day):
    site = replace(SITE, known_ground=(KnownGround("pad", 0.01, ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))),))
    path = next_file(day.folder, day.reader, site, FUTURE)
    file = ArchiveFile(path)
    assert (file.header.site, file.header.frame, file.header.crs) == (site, SITE.frame, SITE.crs)
    assert (file.first_row, file.last_row, file.samples, file.header.machines) == (1, 3, 18, ("a", "b"))
    assert file.first_received_ns == NOW_NS


def test_every_sample_is_a_line_for_other_tools(day):
    rows = list(day.reader.read(until=3))
    path = day.folder / day.archive()[0]
    table = pq.read_table(path, page_checksum_verification=True)
    assert table.column("machine").to_pylist() == [row.machine for row in rows for _ in row.rows]
    assert table.column("spool_id").to_pylist() == [row.spool_id for row in rows for _ in row.rows]
    assert table.column("seq").to_pylist() == [row.first_seq + i for row in rows for i in range(len(row.rows))]
    assert table.column("row").to_pylist() == [row.row for row in rows for _ in row.rows]
    assert table.column("received_ns").to_pylist() == [row.received_ns for row in rows for _ in row.rows]
    for name in ("stamp_ns", "x_m", "c_rr"):
        assert table.column(name).to_numpy().tobytes() == np.concatenate([row.rows[name] for row in rows]).tobytes()
    columns = pq.ParquetFile(path).metadata.row_group(0).to_dict()["columns"]
    assert {column["compression"] for column in columns} == {"ZSTD"}


def test_every_bit_of_odd_numbers_is_kept(tmp_path):
    with opened(tmp_path) as machines:
        rows = samples(6)
        rows["c_rr"].view("<u4")[:] = [0x7FC00000, 0x7FC00001, 0xFFC00000, 0x7F800001, 0x80000000, 0]  # NaN, -0, 0
        rows["c_rr_var"][:4] = np.nan
        rows["x_m"] = [-0.0, 0.0, 5e-324, -1e-300, 0.1, 20_000]
        put(machines.journal, batch(rows))
        before = machines.both()
        machines.archive()
        assert machines.both() == before


def test_without_pyarrow_the_error_says_what_to_install(day, monkeypatch):
    def missing(name: str) -> None:
        raise ModuleNotFoundError(name)

    monkeypatch.setattr(archive_file, "import_module", missing)
    with pytest.raises(ConfigError, match=r"pyarrow is not installed: pip install '\.\[archive\]'"):
        day.archive()
    assert day.journal.archived_row == 0


def test_a_full_disk_leaves_the_journal_as_it_was(day, monkeypatch):
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    before = day.both()
    monkeypatch.setattr(files.os, "fsync", full)
    with pytest.raises(StoreError, match=r"cannot be written.*No space"):
        day.archive()
    monkeypatch.undo()
    assert (list(day.folder.iterdir()), day.journal.archived_row, day.both()) == ([], 0, before)


PLACE = Bounds(-20.0, -20.0, 10.0, 15.0)
FILTERS = [
    Selection(from_ns=NOW_NS + 900 * 10**9),
    Selection(to_ns=NOW_NS + 200 * 10**9),
    Selection(bounds=PLACE),
    Selection(bounds=Bounds(59.0, 59.0, 60.0, 60.0)),
    Selection(without=frozenset({"a"})),
    Selection(without=frozenset({"a", "b", "c"})),
    Selection(to_ns=NOW_NS + 600 * 10**9, bounds=PLACE, without=frozenset({"b"})),
]


@pytest.mark.parametrize("selection", FILTERS)
def test_filters_choose_the_same_rows_in_journal_and_archive(day, selection):
    before = day.both(selection)
    day.archive(NOW_NS + 2 * HOUR_NS)
    assert day.both(selection) == before


@pytest.fixture
def file(day) -> tuple[Path, list[tuple]]:
    path = day.folder / day.archive()[0]
    return path, plain(ArchiveFile(path).read())


def test_any_flipped_bit_is_found_and_the_file_is_named(file):
    path, _ = file
    data, seed = path.read_bytes(), 11
    draw = np.random.default_rng(seed)
    for place in {*range(16), *range(len(data) - 20, len(data)), *draw.integers(0, len(data), 100).tolist()}:
        damaged = bytearray(data)
        damaged[place] ^= 1 << int(draw.integers(8))
        path.write_bytes(damaged)
        with pytest.raises(StoreError, match=f"{path.name}: is damaged"):
            list(ArchiveFile(path).read())


@pytest.mark.parametrize("share", [0.0, 0.001, 0.3, 0.9, 0.999])
def test_a_file_cut_short_is_found(file, share):
    path, _ = file
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    with pytest.raises(StoreError, match=f"{path.name}: is damaged"):
        ArchiveFile(path)


def test_damaged_statistics_do_not_hide_rows(file, day):
    """Skipping a file by filter trusts its footer, so that is always checked."""
    path, _ = file
    data = bytearray(path.read_bytes())
    data[-60] ^= 1
    path.write_bytes(data)
    with pytest.raises(StoreError, match="is damaged"):
        list(archived(day.folder, 0, 7, Selection(from_ns=FUTURE)))


def test_what_is_no_file_of_this_archive_is_refused(day, tmp_path, monkeypatch):
    import pyarrow as pa

    foreign = tmp_path / "2026-01-01T00_000001-000003.parquet"
    pq.write_table(pa.table({"x": [1]}), foreign)
    with monkeypatch.context() as patch:
        patch.setattr(ar, "asdict", lambda header: asdict(header) | {"schema": 1})
        older = ar.write_file(day.folder, "0" * 16, SITE, ((row, row.received_ns) for row in day.reader.read()))
    older = older.rename(tmp_path / older.name)
    renamed = (day.folder / day.archive()[0]).rename(tmp_path / "2026-01-01T00_000001-000004.parquet")
    for path, problem in (
        (foreign, "no file of a map server's archive"),
        (older, "has schema 1, this version knows 6"),
        (renamed, r"000004\.parquet: holds the rows 1 to 3"),
        (tmp_path / "nothing.parquet", r"nothing\.parquet: cannot be read: No such file"),
    ):
        with pytest.raises(StoreError, match=problem):
            ArchiveFile(path)


def with_values(name: str, change: Callable[[np.ndarray], object]) -> Callable[[pa.Table], pa.Table]:
    """A table with changed values, as in a foreign file."""

    def changed(table: pa.Table) -> pa.Table:
        values = table.column(name).to_numpy(zero_copy_only=False).copy()
        change(values)
        field = table.schema.field(name)
        return table.set_column(table.column_names.index(name), field, pa.array(values, field.type))

    return changed


def putting(value: object, at: int = -1) -> Callable[[np.ndarray], object]:
    return lambda values: values.__setitem__(at, value)


STRANGE = {
    "NaN for a place": (with_values("y_m", putting(np.nan)), "not finite"),
    "no place on any site": (with_values("x_m", putting(-1e300)), "beyond 100000 m"),
    "no covariance": (with_values("cov_xy_m2", putting(9.0)), "positive semidefinite"),
    "half a measurement": (with_values("grade_var", putting(np.nan)), "together or not at all"),
    "a machine that is a path": (with_values("machine", putting("../../x")), "machine '../../x' is not among"),
    "a row of two spools": (with_values("spool_id", putting(9)), "no batch of one machine"),
    "a number twice": (with_values("seq", putting(1)), "no batch of one machine"),
    "a number beyond the last": (with_values("seq", lambda seq: seq.__iadd__(2**62)), "not in order"),
    "rows that go back": (
        with_values("row", lambda row: row.__setitem__(slice(None), row[::-1].copy())),
        "not in order",
    ),
    "text for a number": (
        lambda t: t.set_column(5, "stamp_ns", t.column("stamp_ns").cast(pa.string())),
        "stamp_ns: string",
    ),
    "single precision": (lambda t: t.set_column(6, "x_m", t.column("x_m").cast(pa.float32())), "x_m: float"),
    "a column too few": (lambda t: t.drop_columns(["c_rr"]), "c_rr is missing"),
    "a column too many": (lambda t: t.append_column("note", t.column("row")), "note: int64 is none"),
    "no samples": (lambda t: t.slice(0, 0), "no samples"),
}


@pytest.mark.parametrize("name", STRANGE)
def test_a_file_of_a_stranger_is_refused_in_one_line_for_what_it_holds(file, name):
    """Its seal is right, as anybody can make one."""
    path, _ = file
    change, problem = STRANGE[name]
    header, table = pq.read_metadata(path).metadata[archive_file.KEY], pq.read_table(path)
    with path.open("w+b") as written:
        pq.write_table(change(table).replace_schema_metadata({archive_file.KEY: header}), written)
        archive_file.seal(written)
    with pytest.raises(StoreError, match="is no file that a map server wrote") as caught:
        list(ArchiveFile(path).read())
    assert problem in str(caught.value)


def test_a_missing_file_is_an_error(day):
    names = day.archive()
    (day.folder / names[1]).unlink()
    assert len(plain(archived(day.folder, 0, 3))) == 3
    for after, until in ((0, 7), (3, 6), (0, 4)):
        with pytest.raises(StoreError, match="the file with row 4 is missing"):
            list(archived(day.folder, after, until))
    (day.folder / names[2]).unlink()
    with pytest.raises(StoreError, match="the file with row 7 is missing"):
        list(archived(day.folder, 6, 7))


def test_two_files_with_the_same_row_are_an_error(day):
    names = day.archive()
    twice = [(row, row.received_ns) for row in ArchiveFile(day.folder / names[0]).read() if row.row == 3]
    ar.write_file(day.folder, "0" * 16, SITE, iter(twice))
    with pytest.raises(StoreError, match="row 3 is also in another file"):
        list(archived(day.folder, 0, 7))


class Crash(BaseException):
    """Any sudden end of the process."""


STEPS = {"write_parquet": ar, "seal": ar, "sync_folder": ar, "sync_folder of the temporary file": files, "_compare": ar}


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize("when", ["before", "after"])
def test_a_crash_at_any_step_loses_and_doubles_nothing(day, monkeypatch, step, when):
    before, name = day.both(), step.split()[0]
    real = getattr(STEPS[step], name)

    def crash(*arguments: object) -> None:
        if when == "after":
            real(*arguments)
        raise Crash

    monkeypatch.setattr(STEPS[step], name, crash)
    with pytest.raises(Crash):
        day.archive()
    assert day.both() == before
    monkeypatch.undo()
    assert len(day.archive()) == 3
    assert day.both() == before
    assert len(list(day.folder.iterdir())) == 3


@pytest.mark.parametrize("pieces", [0, 1, 2, 4])
def test_a_crash_while_rows_are_forgotten_is_made_good(day, pieces):
    before, left = day.both(), pieces

    def forget(until: int) -> int:
        nonlocal left
        if not left:
            raise Crash
        left -= 1
        return day.journal.forget(until, most=1)

    with pytest.raises(Crash):
        day.archive(forget=forget)
    assert day.journal.archived_row == pieces
    assert day.both() == before
    day.archive()
    assert day.both() == before
    assert len(list(day.folder.iterdir())) == 3


def test_nothing_is_forgotten_before_file_and_name_are_on_disk(day, monkeypatch):
    done = []

    def spy(name: str, real: Callable) -> Callable:
        def call(first: object, *rest: object) -> object:
            done.append(f"{name} folder" if name == "sync" and stat.S_ISDIR(os.fstat(first).st_mode) else name)
            return real(first, *rest)

        return call

    monkeypatch.setattr(files.os, "fsync", spy("sync", os.fsync))
    monkeypatch.setattr(Path, "replace", spy("replace", Path.replace))
    monkeypatch.setattr(Path, "rename", spy("rename", Path.rename))
    day.archive(NOW_NS + HOUR_NS, forget=spy("forget", day.journal.forget))
    assert done == ["sync", "replace", "sync folder", "rename", "sync folder", "forget"]


YEAR_NS = 365 * 24 * HOUR_NS


def test_rows_that_came_in_next_year_keep_nothing_from_the_archive(tmp_path):
    """Two rows came with the server's clock a year ahead; they count for the next right row's hour."""
    with opened(tmp_path) as machines:
        for hours, off_ns in ((0, 0), (0, YEAR_NS), (1, YEAR_NS), (1, 0), (2, 0), (5, 0)):
            machines.send(3, NOW_NS + hours * HOUR_NS + off_ns)
        before, now_ns = machines.both(), NOW_NS + 5 * HOUR_NS
        names = machines.archive(NOW_NS + 3 * HOUR_NS, now_ns=now_ns)
        spans = ("00_000001-000001", "01_000002-000004", "02_000005-000005")
        assert names == [f"2026-01-01T{span}.parquet" for span in spans]
        assert machines.both() == before  # also receive times, as in the journal


def test_rows_that_came_in_next_year_wait_for_one_that_did_not(tmp_path):
    with opened(tmp_path) as machines:
        machines.send(3, NOW_NS)
        machines.send(3, NOW_NS + YEAR_NS)
        later = {"before_ns": NOW_NS + 30 * HOUR_NS, "now_ns": NOW_NS + 54 * HOUR_NS}
        assert len(machines.archive(**later)) == 1
        assert machines.archive(**later) == []
        machines.send(3, NOW_NS + 29 * HOUR_NS - 1)
        assert machines.archive(**later) == ["2026-01-02T04_000002-000003.parquet"]


def test_a_file_that_is_not_the_journal_s_is_never_a_reason_to_forget(day):
    """The journal was restored from a backup and continued with other rows."""
    path = next_file(day.folder, day.reader, SITE, FUTURE)
    third = list(day.reader.read())[2]
    with closing(sqlite3.connect(day.journal.path, isolation_level=None)) as db:

        def put(row: int, value: bytes) -> bytes:
            ((before,),) = db.execute("SELECT record FROM journal WHERE row = ?", (row,)).fetchall()
            db.execute("UPDATE journal SET record = ? WHERE row = ?", (value, row))
            return before

        put(3, record(replace(third, received_ns=third.received_ns + 1)))
        with pytest.raises(StoreError, match=r"000003\.parquet: row 3 is not the journal's; .* move this file away"):
            day.archive()
        before = put(1, b"damaged")
        with pytest.raises(StoreError, match="row 1 is damaged"):
            day.archive()
        put(1, before)
    assert day.journal.archived_row == 0
    path.rename(path.with_suffix(".away"))
    assert len(day.archive()) == 3


def test_files_and_row_groups_outside_are_not_decoded(tmp_path, monkeypatch):
    monkeypatch.setattr(ar, "GROUP_SAMPLES", 1)
    with opened(tmp_path) as machines:
        for i in range(4):
            rows = samples(3, x_m=10.0 * i, stamp_ns=NOW_NS + i)
            put(machines.journal, batch(rows, 1 + 3 * i), NOW_NS + i // 2 * HOUR_NS)
        machines.archive()
        decoded: list[int] = []
        real = archive_file._rows
        monkeypatch.setattr(archive_file, "_rows", lambda table, *rest: decoded.append(1) or real(table, *rest))
        checked: list[Path] = []
        whole = archive_file._checked
        monkeypatch.setattr(archive_file, "_checked", lambda path: checked.append(path) or whole(path))
        for selection, groups, files in (
            (ALL, 4, 2),
            (Selection(bounds=Bounds(9, 0, 11, 20)), 1, 1),
            (Selection(to_ns=NOW_NS + 2), 3, 2),
            (Selection(from_ns=NOW_NS + 4), 0, 0),
            (Selection(without=frozenset({"a"})), 0, 0),
        ):
            decoded.clear(), checked.clear()
            list(archived(machines.folder, 0, 4, selection))
            assert (len(decoded), len(checked)) == (groups, files), selection
