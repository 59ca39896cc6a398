import shutil
import signal
import sqlite3
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from agents_drives import made_up_samples

from agents.audit import AuditLog, read_audit
from agents.spool import Spool, SpoolConfig
from protocol.errors import StoreError
from protocol.samples import content_hash

ROWS = made_up_samples(60)
ROOT = Path(__file__).resolve().parents[3]


def opened(path: Path, max_samples: int = 1000, audit: AuditLog | None = None) -> Spool:
    return Spool(path / "spool.db", SpoolConfig(max_samples), audit)


def hashes(rows: np.ndarray) -> list[str]:
    return [content_hash(row) for row in rows]


def test_samples_are_numbered_from_one_and_come_out_in_order(tmp_path: Path) -> None:
    spool = opened(tmp_path)
    assert spool.head(10) is None
    assert spool.record(ROWS[:4]) == 1
    assert spool.record(ROWS[4:9]) == 5
    head = spool.head(7)
    assert head
    assert (head.spool_id, head.first_seq, head.lost_before) == (spool.spool_id, 1, 0)
    assert hashes(head.rows) == hashes(ROWS[:7])
    assert spool.newest == 9
    spool.close()


def test_commits_are_full_and_logged_ahead(tmp_path: Path) -> None:
    spool = opened(tmp_path)
    assert spool._db.execute("PRAGMA synchronous").fetchone()[0] == 2
    assert spool._db.execute("PRAGMA journal_mode").fetchone()[0] == "wal"
    spool.close()


def test_acknowledged_samples_are_deleted_and_stay_so(tmp_path: Path) -> None:
    spool = opened(tmp_path)
    spool.record(ROWS[:10])
    spool.acknowledge(6)
    assert (spool.acknowledged, spool.counters()["depth"]) == (6, 4)
    spool.close()
    again = opened(tmp_path)
    head = again.head(99)
    assert head
    assert (head.first_seq, len(head.rows), head.lost_before) == (7, 4, 0)
    assert again.record(ROWS[10:11]) == 11
    again.close()


def test_spool_keeps_its_identity_and_two_spools_differ(tmp_path: Path) -> None:
    ids = []
    for name in ("a", "a", "b"):
        spool = opened(tmp_path / name)
        ids.append(spool.spool_id)
        spool.close()
    assert ids[0] == ids[1] != ids[2]
    assert 0 < min(ids) <= max(ids) < 2**64


def test_spool_survives_a_process_that_never_closes_it(tmp_path: Path) -> None:
    spool = opened(tmp_path)
    spool.record(ROWS[:5])
    again = opened(tmp_path)
    head = again.head(99)
    assert head
    assert hashes(head.rows) == hashes(ROWS[:5])
    again.close()
    spool._db.close()


WRITER = """
import sys
from pathlib import Path
from agents_drives import made_up_samples
from agents.audit import AuditLog
from agents.spool import Spool, SpoolConfig
folder = Path(sys.argv[1])
spool = Spool(folder / "spool.db", SpoolConfig(), AuditLog(folder / "audit.txt"))
rows = made_up_samples(100_000)
for i in range(0, len(rows), 7):
    spool.record(rows[i : i + 7])
    print(i + 7, flush=True)
"""


def test_spool_survives_kill_in_the_middle_of_writing(tmp_path: Path) -> None:
    paths = f"{ROOT}:{Path(__file__).parent}"
    command = [sys.executable, "-c", WRITER, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env={"PYTHONPATH": paths}) as writer:
        assert writer.stdout
        told = 0
        for line in writer.stdout:
            told = int(line)
            if told >= 300:
                writer.send_signal(signal.SIGKILL)
                break
        told = max([told, *map(int, writer.stdout.read().split())])
    assert writer.returncode == -signal.SIGKILL
    audit = AuditLog(tmp_path / "audit.txt")
    spool = opened(tmp_path, 10**6, audit)
    assert spool.newest >= told
    head = spool.head(10**6)
    assert head
    assert head.first_seq == 1
    assert hashes(head.rows) == hashes(made_up_samples(100_000)[: len(head.rows)])
    assert len(head.rows) == spool.newest == spool.counters()["recorded"]
    spool.close()
    assert list(read_audit(tmp_path / "audit.txt").values()) == hashes(head.rows)


def test_kill_while_the_file_is_made_leaves_no_broken_spool(tmp_path: Path) -> None:
    def killed() -> int:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Spool(tmp_path / "spool.db", SpoolConfig(), draw_id=killed)
    spool = opened(tmp_path)
    assert spool.record(ROWS[:2]) == 1
    spool.close()


# --- pending and final -----------------------------------------------------------------------------------------------


def test_pending_samples_wait_until_they_are_final(tmp_path: Path) -> None:
    spool = opened(tmp_path)
    spool.record(ROWS[:3], final=False)
    assert spool.head(99) is None
    better = ROWS[:2].copy()
    better["x_m"] += 1
    spool.finalise(1, better)
    head = spool.head(99)
    assert head
    assert hashes(head.rows) == hashes(better)
    spool.close()


def test_final_samples_never_overtake_pending_ones(tmp_path: Path) -> None:
    spool = opened(tmp_path)
    spool.record(ROWS[:2])
    spool.record(ROWS[2:4], final=False)
    spool.record(ROWS[4:6])
    head = spool.head(99)
    assert head
    assert len(head.rows) == 2
    spool.acknowledge(2)
    assert spool.head(99) is None
    spool.finalise(3, ROWS[2:4])
    head = spool.head(99)
    assert head
    assert (head.first_seq, len(head.rows)) == (3, 4)
    spool.close()


def test_what_is_final_stays_as_it_is(tmp_path: Path) -> None:
    spool = opened(tmp_path)
    spool.record(ROWS[:1])
    spool.finalise(1, ROWS[5:6])
    head = spool.head(1)
    assert head
    assert hashes(head.rows) == hashes(ROWS[:1])
    spool.close()


def test_pending_samples_are_final_after_a_crash(tmp_path: Path) -> None:
    spool = opened(tmp_path)
    spool.record(ROWS[:3], final=False)
    spool._db.close()
    again = opened(tmp_path)
    head = again.head(99)
    assert head
    assert hashes(head.rows) == hashes(ROWS[:3])
    again.close()


# --- holes, bounds, and samples that the server refuses --------------------------------------------------------------


def test_head_ends_before_a_hole(tmp_path: Path) -> None:
    spool = opened(tmp_path)
    spool.record(ROWS[:10])
    bad = spool.head(99)
    assert bad
    spool.acknowledge(3)
    spool.put_aside(type(bad)(bad.spool_id, 6, ROWS[5:6], 0), "too bad")
    first = spool.head(99)
    assert first
    assert (first.first_seq, len(first.rows), first.lost_before) == (4, 2, 0)
    spool.acknowledge(5)
    rest = spool.head(99)
    assert rest
    assert (rest.first_seq, len(rest.rows), rest.lost_before) == (7, 4, 1)
    assert spool.counters()["put_aside"] == 1
    aside = spool._db.execute("SELECT seq, row, problem FROM aside").fetchall()
    assert aside == [(6, ROWS[5].tobytes(), "too bad")]
    spool.close()


@pytest.mark.parametrize("limit", [1, 10])
def test_full_spool_drops_the_oldest_counts_them_and_declares_them_lost(tmp_path: Path, limit: int) -> None:
    spool = opened(tmp_path, limit)
    for i in range(0, 60, 4):
        spool.record(ROWS[i : i + 4])
    head = spool.head(99)
    assert head
    assert (head.first_seq, head.lost_before) == (61 - limit, 60 - limit)
    assert hashes(head.rows) == hashes(ROWS[-limit:])
    expected = {"depth": limit, "dropped": 60 - limit, "put_aside": 0, "recorded": 60}
    assert spool.counters() == expected
    spool.close()
    again = opened(tmp_path, limit)
    assert again.counters() == expected
    again.close()


# --- first contact with the server -----------------------------------------------------------------------------------


def test_watermark_within_the_spool_is_an_acknowledgement(tmp_path: Path) -> None:
    spool = opened(tmp_path)
    spool.record(ROWS[:5])
    spool.close()
    again = opened(tmp_path)
    identity = again.spool_id
    assert not again.meet(3)
    assert (again.spool_id, again.acknowledged, again.counters()["depth"]) == (identity, 3, 2)
    again.close()


def test_server_that_knows_less_than_it_acknowledged_is_told_what_is_lost(tmp_path: Path) -> None:
    spool = opened(tmp_path)
    spool.record(ROWS[:10])
    spool.acknowledge(8)
    spool.close()
    again = opened(tmp_path)
    assert not again.meet(5)
    head = again.head(99)
    assert head
    assert (head.first_seq, head.lost_before) == (9, 3)
    again.close()


def test_restored_copy_gets_a_new_identity_and_loses_and_doubles_nothing(tmp_path: Path) -> None:
    audit = tmp_path / "audit.txt"
    spool = opened(tmp_path / "now", audit=AuditLog(audit))
    spool.record(ROWS[:10])
    spool.acknowledge(4)
    spool.close()
    (tmp_path / "copy").mkdir()
    shutil.copy(tmp_path / "now/spool.db", tmp_path / "copy/spool.db")
    spool = opened(tmp_path / "now")
    spool.record(ROWS[10:15])  # 11 to 15, delivered
    spool.close()

    restored = opened(tmp_path / "copy", audit=AuditLog(audit))
    old = restored.spool_id
    assert restored.record(ROWS[20:23]) == 11  # the same numbers again
    assert restored.meet(15)
    assert restored.spool_id != old
    head = restored.head(99)
    assert head
    assert (head.spool_id, head.first_seq, head.lost_before) == (restored.spool_id, 1, 0)
    assert hashes(head.rows) == hashes(ROWS[20:23])
    assert restored.record(ROWS[23:24]) == 4
    recorded = read_audit(audit)
    assert [recorded[restored.spool_id, seq] for seq in (1, 2, 3, 4)] == hashes(ROWS[20:24])
    assert (old, 11) not in recorded
    assert recorded[old, 10] == hashes(ROWS[9:10])[0]
    restored.close()
    again = opened(tmp_path / "copy")
    assert not again.meet(2)
    assert again.newest == 4
    again.close()


def test_new_spool_meets_a_server_that_knows_nothing(tmp_path: Path) -> None:
    spool = opened(tmp_path)
    spool.record(ROWS[:3])  # recorded before the first contact
    assert not spool.meet(0)
    head = spool.head(99)
    assert head
    assert (head.first_seq, len(head.rows), head.lost_before) == (1, 3, 0)
    spool.close()


# --- errors ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "damage", [b"no database at all, but long enough to be taken for one", b"SQLite format 3\0" * 9]
)
def test_damaged_file_is_a_store_error(tmp_path: Path, damage: bytes) -> None:
    (tmp_path / "spool.db").write_bytes(damage)
    with pytest.raises(StoreError, match=r"spool\.db"):
        opened(tmp_path)


def test_spool_of_another_schema_is_a_store_error(tmp_path: Path) -> None:
    opened(tmp_path).close()
    db = sqlite3.connect(tmp_path / "spool.db")
    db.execute("PRAGMA user_version=99")
    db.close()
    with pytest.raises(StoreError, match="schema 99"):
        opened(tmp_path)


def test_spool_that_has_lost_its_identity_is_a_store_error(tmp_path: Path) -> None:
    opened(tmp_path).close()
    db = sqlite3.connect(tmp_path / "spool.db", isolation_level=None)
    db.execute("DELETE FROM meta WHERE key = 'spool_id'")
    db.close()
    with pytest.raises(StoreError):
        opened(tmp_path)


def test_failed_record_changes_nothing(tmp_path: Path) -> None:
    spool = opened(tmp_path)
    spool.record(ROWS[:2])
    spool._db.execute("INSERT INTO sample VALUES (4, x'00', 1)")  # in the way
    with pytest.raises(StoreError, match="UNIQUE"):
        spool.record(ROWS[2:5])
    spool._db.execute("DELETE FROM sample WHERE seq = 4")
    assert spool.newest == 2
    assert spool.record(ROWS[2:5]) == 3
    assert spool.counters()["recorded"] == 5
    spool.close()


def test_bad_spool_option_is_refused_by_name() -> None:
    with pytest.raises(ValueError, match="max_samples"):
        SpoolConfig(max_samples=0)


def test_disk_that_takes_nothing_is_named(tmp_path: Path) -> None:
    spool = Spool(tmp_path / "spool.db", SpoolConfig())
    spool._db.execute("PRAGMA query_only = ON")
    with pytest.raises(StoreError, match=r"spool\.db: cannot be written: .*; look at the machine's disk"):
        spool.record(made_up_samples(2))
    assert spool.newest == 0
    spool._db.execute("PRAGMA query_only = OFF")
    assert spool.record(made_up_samples(2)) == 1
    spool.close()
