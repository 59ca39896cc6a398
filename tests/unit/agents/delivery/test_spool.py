import contextlib
import random
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agents.delivery.audit import AuditLog, Contents, read_audit
from agents.delivery.spool import KEPT_RUNS, Spool, SpoolConfig
from agents.delivery.spool_file import connect
from agents.delivery.write_buffer import WriteBuffer
from protocol.errors import StoreError
from protocol.machine.samples import content_hash, empty
from tests.paths import ROOT
from tests.unit.agents.drives import made_up_samples

ROWS = made_up_samples(60)
EMPTY = {"depth": 0, "pending": 0, "dropped": 0, "put_aside": 0, "recorded": 0, "gone": 0}


def opened(path: Path, max_samples: int = 1000, audit: AuditLog | None = None) -> Spool:
    return Spool(path / "spool.db", SpoolConfig(max_samples), audit)


@pytest.fixture
def spool(tmp_path: Path) -> Iterator[Spool]:
    spool = opened(tmp_path)
    yield spool
    spool.close()


def kill(spool: Spool) -> None:
    """End its process."""
    spool._db.close()


def changed(path: Path, statement: str) -> Path:
    """The folder of a closed spool, its file changed by a statement."""
    with contextlib.closing(sqlite3.connect(path / "spool.db")) as db, db:
        db.execute(statement)
    return path


def quarantined(path: Path) -> list[tuple[int, bytes, str]]:
    """Number, sample and problem of a closed spool's quarantine."""
    with contextlib.closing(sqlite3.connect(path / "spool.db")) as db:
        return db.execute("SELECT seq, row, problem FROM quarantine ORDER BY seq").fetchall()


def hashes(rows: np.ndarray) -> list[str]:
    return [content_hash(row) for row in rows]


def test_commits_are_full_and_logged_ahead(spool: Spool) -> None:
    assert spool._db.execute("PRAGMA synchronous").fetchone()[0] == 2
    assert spool._db.execute("PRAGMA journal_mode").fetchone()[0] == "wal"


def test_runs_that_are_closed_are_declared_again_at_each_opening_and_forgotten_in_the_end(tmp_path: Path) -> None:
    for _ in range(KEPT_RUNS + 2):
        spool = opened(tmp_path)
        closing = 0
        while head := spool.head(9):
            assert (len(head.rows), head.first_seq, head.lost_before) == (0, 3, 2)
            spool.acknowledge(head.spool_id, 2)
            closing += 1
        assert closing <= KEPT_RUNS
        spool.record(ROWS[:2])
        spool.acknowledge(spool.spool_id, 2)
        spool.close()
    assert closing == KEPT_RUNS


def test_runs_that_are_not_closed_are_never_forgotten(tmp_path: Path) -> None:
    for i in range(KEPT_RUNS + 5):
        spool = opened(tmp_path, max_samples=1)
        spool.record(ROWS[i : i + 1])
        spool.close()
    spool = opened(tmp_path, max_samples=1)
    closed = 0
    while head := spool.head(9):
        closed += not len(head.rows)
        spool.acknowledge(head.spool_id, head.first_seq - 1 + len(head.rows))
    assert closed == KEPT_RUNS + 4, "all but the one whose sample is left: what was dropped is declared"
    spool.close()


def test_spool_that_another_process_has_open_is_refused(tmp_path: Path) -> None:
    spool = opened(tmp_path)
    script = (
        "import sys; from pathlib import Path; from agents.delivery.spool import Spool, SpoolConfig; "
        "Spool(Path(sys.argv[1]), SpoolConfig())"
    )
    command = [sys.executable, "-c", script, str(tmp_path / "spool.db")]
    ended = subprocess.run(command, capture_output=True, text=True, env={"PYTHONPATH": str(ROOT)}, check=False)
    assert "another agent is using this spool" in ended.stderr
    kill(spool)
    opened(tmp_path).close()


WRITER = """
import sys
from pathlib import Path
from tests.unit.agents.drives import made_up_samples
from agents.delivery.audit import AuditLog
from agents.delivery.spool import KEPT_RUNS, Spool, SpoolConfig
folder = Path(sys.argv[1])
spool = Spool(folder / "spool.db", SpoolConfig(), AuditLog(folder / "audit.txt"))
rows = made_up_samples(100_000)
for i in range(0, len(rows), 7):
    spool.record(rows[i : i + 7])
    print(i + 7, flush=True)
"""


def test_spool_survives_kill_in_the_middle_of_writing(tmp_path: Path) -> None:
    command = [sys.executable, "-c", WRITER, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env={"PYTHONPATH": str(ROOT)}) as writer:
        assert writer.stdout
        printed = 0
        for line in writer.stdout:
            printed = int(line)
            if printed >= 300:
                writer.send_signal(signal.SIGKILL)
                break
        printed = max([printed, *map(int, writer.stdout.read().split())])
    assert writer.returncode == -signal.SIGKILL
    audit = AuditLog(tmp_path / "audit.txt")
    spool = opened(tmp_path, 10**6, audit)
    head = spool.head(10**6)
    assert len(head.rows) >= printed
    assert head.first_seq == 1
    assert hashes(head.rows) == hashes(made_up_samples(100_000)[: len(head.rows)])
    assert len(head.rows) == spool.counters()["recorded"]
    spool.close()
    assert list(read_audit(tmp_path / "audit.txt").values()) == [(content,) for content in hashes(head.rows)]


# --- pending and final -----------------------------------------------------------------------------------------------


def better(rows: np.ndarray) -> np.ndarray:
    rows = rows.copy()
    rows["x_m"] += 1
    return rows


@pytest.mark.parametrize(("n", "pending", "finals"), [(1, 0, 1), (0, 0, 3), (1, 2, 0), (2, 1, 0), (0, -1, 0)])
def test_no_sample_is_final_before_an_earlier_one(spool: Spool, n: int, pending: int, finals: int) -> None:
    spool.record(ROWS[:2], pending=2)
    with pytest.raises(ValueError, match="pending samples"):
        spool.record(ROWS[:n], pending=pending, finals=ROWS[:finals])
    assert spool.counters() == {**EMPTY, "depth": 2, "pending": 2, "recorded": 2}


def test_pending_samples_that_a_copy_of_the_file_has_delivered_are_passed_over(tmp_path: Path) -> None:
    """They are sent as they are, under this spool's numbers."""
    spool = opened(tmp_path, 2, AuditLog(tmp_path / "audit"))
    spool.record(ROWS[:6], pending=6)
    spool.acknowledge(spool.spool_id, 4)
    assert (spool.acknowledged, spool.counters()["depth"], spool.counters()["pending"]) == (4, 2, 2)
    spool.record(ROWS[6:8], pending=2, finals=better(ROWS[:3]))
    assert spool.head(99) is None
    assert spool.counters() == {**EMPTY, "depth": 4, "pending": 4, "recorded": 8}
    spool.record(ROWS[:0], finals=better(ROWS[3:7]))
    head = spool.head(99)
    assert (head.first_seq, head.lost_before, hashes(head.rows)) == (6, 1, hashes(better(ROWS[5:7])))
    spool.close()
    rows = np.concatenate([ROWS[:4], better(ROWS[4:7]), ROWS[7:8]])
    assert list(read_audit(tmp_path / "audit").values()) == [(content,) for content in hashes(rows)]


@pytest.mark.parametrize("limit", [1, 3])
def test_full_spool_drops_no_pending_sample(tmp_path: Path, limit: int) -> None:
    """Pending samples do not count: a spool below the lag would drop each before its final value."""
    spool = opened(tmp_path, limit)
    spool.record(ROWS[:10], pending=10)
    assert (spool.counters()["depth"], spool.counters()["dropped"]) == (10, 0)
    spool.record(ROWS[10:12], pending=2, finals=better(ROWS[:6]))
    assert (spool.counters()["depth"], spool.counters()["dropped"]) == (6 + limit, 6 - limit)
    head = spool.head(99)
    assert (head.first_seq, head.lost_before) == (7 - limit, 6 - limit)
    assert hashes(head.rows) == hashes(better(ROWS[6 - limit : 6]))
    spool.close()


# --- holes, bounds, refused samples ----------------------------------------------------------------------------------


@pytest.mark.parametrize("limit", [1, 10])
def test_full_spool_drops_the_oldest_counts_them_and_declares_them_lost(tmp_path: Path, limit: int) -> None:
    spool = opened(tmp_path, limit)
    for i in range(0, 60, 4):
        spool.record(ROWS[i : i + 4])
    head = spool.head(99)
    assert (head.first_seq, head.lost_before) == (61 - limit, 60 - limit)
    assert hashes(head.rows) == hashes(ROWS[-limit:])
    expected = {**EMPTY, "depth": limit, "dropped": 60 - limit, "recorded": 60}
    assert spool.counters() == expected
    spool.close()
    again = opened(tmp_path, limit)
    assert again.counters() == expected
    again.close()


def test_damaged_samples_are_quarantined_and_never_sent(tmp_path: Path) -> None:
    spool = opened(tmp_path)
    spool.record(ROWS[:10])
    spool.close()
    for numbers, row in (("1, 2", "zeroblob(88)"), ("3", "x'0102'"), ("6", "5")):
        changed(tmp_path, f"UPDATE sample SET row = {row} WHERE number IN ({numbers})")
    spool = opened(tmp_path)
    first = spool.head(2)
    assert (first.first_seq, first.lost_before) == (4, 3)
    assert hashes(first.rows) == hashes(ROWS[3:5])
    spool.acknowledge(first.spool_id, 5)
    rest = spool.head(99)
    assert (rest.first_seq, rest.lost_before) == (7, 1)
    assert hashes(rest.rows) == hashes(ROWS[6:10])
    assert spool.counters() == {**EMPTY, "depth": 4, "put_aside": 4, "recorded": 10}
    spool.close()
    problem = "damaged on the machine's disk"
    assert [(seq, why) for seq, _, why in quarantined(tmp_path)] == [(seq, problem) for seq in (1, 2, 3, 6)]


# --- errors ----------------------------------------------------------------------------------------------------------


def unreadable(folder: Path, damage: bytes) -> Path:
    (folder / "spool.db").write_bytes(damage)
    return folder


@pytest.mark.parametrize(
    ("damage", "problem"),
    [
        (lambda f: unreadable(f, b"no database at all, but long enough to be taken for one"), r"spool\.db"),
        (lambda f: unreadable(f, b"SQLite format 3\0" * 9), r"spool\.db"),
        (lambda f: changed(f, "PRAGMA user_version=99"), "schema 99"),
        (lambda f: changed(f, "DELETE FROM meta WHERE key = 'newest'"), r"spool\.db"),
        *(
            (lambda f, column=column: changed(f, f"UPDATE run SET {column}"), "is damaged; move the file away")
            for column in ("spool_id = '00000000000000ff'", "acknowledged = 2", "closed = 1", "crc32 = 5")
        ),
    ],
)
def test_a_file_that_is_not_what_was_written_is_a_store_error(tmp_path: Path, damage: Any, problem: str) -> None:
    """Never a reason for another identity."""
    spool = opened(tmp_path)
    spool.record(ROWS[:3])
    spool.close()
    with pytest.raises(StoreError, match=problem):
        opened(damage(tmp_path))


class FullDisk(sqlite3.Connection):
    """A disk full at some statement; SQLite rolls back itself, or not."""

    rolls_back = False
    full_at = "never"

    def execute(self, statement: str, *values: object) -> sqlite3.Cursor:
        self._fail(statement)
        return super().execute(statement, *values)

    def executemany(self, statement: str, values: Any) -> sqlite3.Cursor:
        self._fail(statement)
        return super().executemany(statement, values)

    def _fail(self, statement: str) -> None:
        if statement.startswith(self.full_at):
            if self.rolls_back:
                super().execute("ROLLBACK")
            raise sqlite3.OperationalError("database or disk is full")


class SpoolOnFullDisk(Spool):
    def _connect(self, path: Path) -> sqlite3.Connection:
        return connect(path, FullDisk)


@pytest.mark.parametrize("rolls_back", [False, True])
def test_failed_commit_leaves_no_transaction_open(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rolls_back: bool
) -> None:
    monkeypatch.setattr(FullDisk, "rolls_back", rolls_back)
    spool = SpoolOnFullDisk(tmp_path / "spool.db", SpoolConfig())
    spool.record(ROWS[:4])
    monkeypatch.setattr(FullDisk, "full_at", "COMMIT")
    with pytest.raises(StoreError, match="disk is full"):
        spool.record(ROWS[4:6])
    head = spool.head(9)
    attempts = (
        lambda: spool.acknowledge(spool.spool_id, 2),
        lambda: spool.quarantine(head, "bad"),
        lambda: spool.record(ROWS[:1], pending=1),
        lambda: spool.lower_watermark(spool.spool_id, -1),
        spool.start_new_run,
    )
    identity = spool.spool_id
    for attempt in attempts:
        with pytest.raises(StoreError, match="disk is full; look at the machine's disk"):
            attempt()
        assert spool.counters() == {**EMPTY, "depth": 4, "recorded": 4}
        assert (spool.spool_id, spool.newest, spool.acknowledged) == (identity, 4, 0)
    monkeypatch.setattr(FullDisk, "full_at", "never")
    assert spool.record(ROWS[4:6]) == 5
    spool.close()


def test_a_damaged_sample_that_cannot_be_removed_is_an_error_and_no_endless_loop(tmp_path: Path) -> None:
    spool = opened(tmp_path)
    spool.record(ROWS[:3])
    spool.close()
    changed(tmp_path, "UPDATE sample SET crc32 = 1 WHERE number = 2")
    changed(tmp_path, "CREATE TRIGGER stays BEFORE DELETE ON sample BEGIN SELECT RAISE(IGNORE); END")
    spool = opened(tmp_path)
    with pytest.raises(StoreError, match="the file is damaged"):
        spool.head(10)
    assert spool.counters()["put_aside"] == 0
    spool.close()


# --- the audit -------------------------------------------------------------------------------------------------------

HASHES = [content_hash(row) for row in ROWS]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "logs" / "audit.txt"


def numbered(spool_id: int, first: int, hashes: list[str]) -> dict[tuple[int, int], Contents]:
    return {(spool_id, first + i): (h,) for i, h in enumerate(hashes)}


def test_what_a_crash_kept_from_being_noted_is_added(path: Path) -> None:
    audit = AuditLog(path)
    audit.recorded(7, 1, ROWS[:3])
    audit.close()
    again = AuditLog(path)
    again.complete([(7, 3, ROWS[2]), (7, 4, ROWS[3]), (8, 1, ROWS[4])])
    again.close()
    assert read_audit(path) == numbered(7, 1, HASHES[:4]) | numbered(8, 1, HASHES[4:5])
    assert path.read_text().count("\n") == 5, "what is known is not repeated"


def test_sample_that_is_on_disk_with_another_content_is_noted_so(path: Path) -> None:
    """Its final value was not noted, or the log is damaged: which of the two was delivered is unknown."""
    audit = AuditLog(path)
    audit.recorded(7, 1, ROWS[:3])
    for _ in range(2):
        audit.complete([(7, 2, ROWS[12])])
    assert read_audit(path) == numbered(7, 1, HASHES[:3]) | {(7, 2): (HASHES[1], HASHES[12])}
    assert path.read_text().count("\n") == 4
    audit.recorded(7, 2, ROWS[13:14])
    audit.close()
    assert read_audit(path) == numbered(7, 1, [HASHES[0], HASHES[13], HASHES[2]])


@pytest.mark.parametrize("cut", [1, 18])
def test_line_that_a_crash_cut_off_counts_for_nothing(path: Path, cut: int) -> None:
    audit = AuditLog(path)
    audit.recorded(7, 1, ROWS[:3])
    audit.close()
    path.write_bytes(path.read_bytes()[:-cut])
    assert read_audit(path) == numbered(7, 1, HASHES[:2])
    again = AuditLog(path)
    again.complete([(7, 3, ROWS[2])])
    again.recorded(7, 4, ROWS[3:4])
    again.close()
    assert read_audit(path) == numbered(7, 1, HASHES[:4])


def test_spool_notes_what_it_records_finalises_and_numbers_anew(tmp_path: Path, path: Path) -> None:
    spool = Spool(tmp_path / "spool.db", SpoolConfig(), AuditLog(path), iter([5, 6]).__next__)
    spool.record(ROWS[:2])
    spool.record(ROWS[2:5], pending=3)
    assert read_audit(path) == numbered(5, 1, HASHES[:5])
    spool.record(ROWS[:0], finals=ROWS[12:14])
    assert read_audit(path) == numbered(5, 1, [*HASHES[:2], *HASHES[12:14], HASHES[4]])
    spool.acknowledge(5, 1)
    spool.start_new_run()
    assert read_audit(path) == numbered(5, 1, HASHES[:1]) | numbered(6, 1, [HASHES[1], *HASHES[12:14], HASHES[4]])
    spool.record(ROWS[:0], finals=ROWS[14:15])
    assert read_audit(path) == numbered(5, 1, HASHES[:1]) | numbered(6, 1, [HASHES[1], *HASHES[12:15]])
    spool.close()


def test_audit_on_a_full_disk_keeps_no_sample_from_the_spool(tmp_path: Path, path: Path) -> None:
    audit = AuditLog(path)
    audit._file.close()
    with Path("/dev/full").open("w", encoding="ascii", buffering=1) as full:
        audit._file = full
        spool = Spool(tmp_path / "spool.db", SpoolConfig(), None, iter([5, 6]).__next__)
        spool._audit = audit
        assert spool.record(ROWS[:2]) == 1
        spool._db.close()
        with contextlib.suppress(OSError):
            full.close()
    Spool(tmp_path / "spool.db", SpoolConfig(), AuditLog(path), iter([6]).__next__).close()
    assert read_audit(path) == numbered(5, 1, HASHES[:2])


# --- the write buffer ------------------------------------------------------------------------------------------------

MANY = made_up_samples(400)
BETTER = better(MANY)


def sendable(spool: Spool) -> bytes:
    head = spool.head(1000)
    return head.rows.tobytes() if head else b""


@pytest.mark.parametrize("seed", range(4))
def test_whatever_the_disk_does_each_sample_gets_its_own_final_value(tmp_path: Path, seed: int) -> None:
    """Random samples, final values, writes and full disks against a list."""
    rng, buffer = random.Random(seed), WriteBuffer()
    spool = Spool(tmp_path / "spool.db", SpoolConfig())
    made = final = 0
    for _ in range(60):
        n = rng.randint(0, min(6, len(MANY) - made))
        k = rng.choice((0, rng.randint(0, made + n - final)))
        buffer.add(MANY[made : made + n], BETTER[final : final + k])
        made, final = made + n, final + k
        if rng.random() < 0.5 and not buffer.is_clean:
            spool._db.execute(f"PRAGMA query_only = {rng.choice(('ON', 'OFF'))}")
            try:
                buffer.write(spool)
            except StoreError:
                assert not buffer.is_clean
                continue
            assert buffer.is_clean
            assert sendable(spool) == BETTER[:final].tobytes(), f"seed={seed}"
            assert spool.counters()["pending"] == made - final
    spool._db.execute("PRAGMA query_only = OFF")
    buffer.add(empty(), BETTER[final:made])
    buffer.write(spool)
    assert sendable(spool) == BETTER[:made].tobytes()
    assert (spool.counters()["recorded"], buffer.given_up) == (made, 0)
    spool.close()


def test_memory_gives_up_the_oldest_that_are_final_and_counts_them(
    spool: Spool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("agents.delivery.write_buffer.MOST_UNSAVED", 8)
    buffer, final = WriteBuffer(), empty()
    for i in range(20):
        final = BETTER[i - 3 : i - 2] if i >= 3 else empty()
        buffer.add(MANY[i : i + 1], final)
    assert (len(buffer), buffer.given_up) == (8, 12)
    buffer.write(spool)
    assert sendable(spool) == BETTER[12:17].tobytes()
    buffer.add(empty(), BETTER[17:20])
    buffer.write(spool)
    assert sendable(spool) == BETTER[12:20].tobytes()
