import contextlib
from pathlib import Path

import pytest

from agents.delivery.audit import AuditLog, Contents, read_audit
from agents.delivery.spool import Spool, SpoolConfig
from protocol.machine.samples import content_hash
from tests.unit.agents.drives import made_up_samples

ROWS = made_up_samples(20)
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
    """Its final value was not noted, or is gone with a damaged log; who knows which of the two has been delivered?"""
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
