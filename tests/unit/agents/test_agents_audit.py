from pathlib import Path

import pytest
from agents_drives import made_up_samples

from agents.audit import AuditLog, parse, read_audit
from agents.spool import Spool, SpoolConfig
from protocol.samples import content_hash

ROWS = made_up_samples(20)
HASHES = [content_hash(row) for row in ROWS]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "logs" / "audit.txt"


def numbered(spool_id: int, first: int, hashes: list[str]) -> dict[tuple[int, int], str]:
    return {(spool_id, first + i): h for i, h in enumerate(hashes)}


def test_what_is_recorded_is_read_back(path: Path) -> None:
    audit = AuditLog(path)
    audit.recorded(2**64 - 1, 1, ROWS[:3])
    audit.recorded(2**64 - 1, 4, ROWS[3:4])
    assert read_audit(path) == numbered(2**64 - 1, 1, HASHES[:4])  # on disk without a close
    audit.close()


def test_later_line_of_the_same_sample_replaces_it(path: Path) -> None:
    audit = AuditLog(path)
    audit.recorded(7, 1, ROWS[:3])
    audit.recorded(7, 2, ROWS[9:10])
    audit.close()
    assert read_audit(path) == numbered(7, 1, [HASHES[0], HASHES[9], HASHES[2]])


def test_renumbered_samples_lose_their_old_identity(path: Path) -> None:
    audit = AuditLog(path)
    audit.recorded(7, 1, ROWS[:5])
    audit.renumbered(7, [4, 5], 8, ROWS[3:5])
    audit.close()
    assert read_audit(path) == numbered(7, 1, HASHES[:3]) | numbered(8, 1, HASHES[3:5])


def test_samples_that_a_crash_kept_from_the_spool_are_void(path: Path) -> None:
    audit = AuditLog(path)
    audit.recorded(7, 1, ROWS[:5])
    audit.recorded(9, 1, ROWS[:5])
    audit.close()
    again = AuditLog(path)
    again.reconcile(7, 3)
    again.recorded(7, 4, ROWS[10:11])
    again.close()
    assert read_audit(path) == numbered(7, 1, [*HASHES[:3], HASHES[10]]) | numbered(9, 1, HASHES[:5])


@pytest.mark.parametrize("cut", [1, 5, 10, 18])
def test_line_that_a_crash_cut_off_counts_for_nothing(path: Path, cut: int) -> None:
    audit = AuditLog(path)
    audit.recorded(7, 1, ROWS[:3])
    audit.close()
    path.write_bytes(path.read_bytes()[:-cut])
    assert read_audit(path) == numbered(7, 1, HASHES[:2])
    again = AuditLog(path)
    again.reconcile(7, 3)
    again.recorded(7, 4, ROWS[3:4])
    again.close()
    assert read_audit(path) == numbered(7, 1, HASHES[:2]) | numbered(7, 4, HASHES[3:4])


def test_void_line_that_was_cut_off_voids_no_other_sample(path: Path) -> None:
    audit = AuditLog(path)
    audit.recorded(7, 1, ROWS[:12])
    audit.close()
    with path.open("a") as file:
        file.write("- 0000000000000007 1")  # of "12"
    assert len(read_audit(path)) == 12


def test_other_lines_are_left_out() -> None:
    assert parse(["", "+", "# a remark", "+ 07 1", "- 07", "* 07 1 aa", "+ 07 1 aa", "+ 07 2 bb # cut off"]) == {
        (7, 1): "aa"
    }


def test_spool_notes_what_it_records_finalises_and_numbers_anew(tmp_path: Path, path: Path) -> None:
    spool = Spool(tmp_path / "spool.db", SpoolConfig(), AuditLog(path), iter([5, 6]).__next__)
    spool.record(ROWS[:2])
    spool.record(ROWS[2:4], final=False)
    spool.finalise(3, ROWS[12:14])
    assert read_audit(path) == numbered(5, 1, [*HASHES[:2], *HASHES[12:14]])
    spool.meet(99)
    assert read_audit(path) == numbered(6, 1, [*HASHES[:2], *HASHES[12:14]])
    spool.close()


def test_dropped_samples_stay_in_the_audit(tmp_path: Path, path: Path) -> None:
    """They were recorded and never reached the server: an audit must show them as lost."""
    spool = Spool(tmp_path / "spool.db", SpoolConfig(max_samples=2), AuditLog(path))
    spool.record(ROWS[:5])
    spool.close()
    assert len(read_audit(path)) == 5
