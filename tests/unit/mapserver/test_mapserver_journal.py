import sqlite3
from pathlib import Path

import msgpack
import numpy as np
import pytest
from mapserver_data import NOW_NS, SITE, batch, random_samples, samples

from mapserver import journal as journal_module
from mapserver.ingest import Admission
from mapserver.journal import Journal, Mark
from protocol.errors import StoreError
from protocol.samples import SAMPLE_DTYPE


def open_journal(folder: Path, site: str = SITE.name, frame: str = SITE.frame) -> Journal:
    return Journal(folder / "journal.db", site, frame)


def write(journal: Journal, *admissions: Admission) -> None:
    journal.begin()
    for admission in admissions:
        journal.append(admission, NOW_NS)
    journal.commit()


def admission(n: int = 3, first_seq: int = 1, lost: int = 0, **more) -> Admission:
    return Admission(batch(random_samples(n, first_seq), first_seq, **more), trimmed=0, lost=lost)


def test_commits_are_synced_to_disk(tmp_path):
    journal = open_journal(tmp_path)
    pragma = {name: journal._db.execute(f"PRAGMA {name}").fetchone()[0] for name in ("journal_mode", "synchronous")}
    assert pragma == {"journal_mode": "wal", "synchronous": 2}  # 2 is FULL
    assert journal._db.execute("PRAGMA journal_size_limit").fetchone()[0] == 64 * 2**20
    journal.close()


def test_rows_read_back_bit_for_bit(tmp_path):
    journal = open_journal(tmp_path)
    first, second = admission(5), admission(4, machine="b", spool_id=2**64 - 1)
    write(journal, first, second)
    rows = list(journal.read())
    assert [(r.row, r.machine, r.spool_id, r.first_seq) for r in rows] == [(1, "a", 7, 1), (2, "b", 2**64 - 1, 1)]
    for row, sent in zip(rows, (first, second), strict=True):
        assert row.rows.tobytes() == sent.batch.rows.tobytes()
    assert [r.row for r in journal.read(after=1)] == [2]
    journal.close()


def test_spool_ids_beyond_signed_integers_are_kept_apart(tmp_path):
    journal = open_journal(tmp_path)
    ids = [1, 2**63 - 1, 2**63, 2**63 + 1, 2**64 - 1]
    write(journal, *(admission(i + 1, spool_id=spool) for i, spool in enumerate(ids)))
    journal.close()
    journal = open_journal(tmp_path)
    assert {spool: mark.seq for (_, spool), mark in journal.marks().items()} == dict(zip(ids, range(1, 6), strict=True))
    journal.close()


def test_rollback_leaves_neither_row_nor_watermark(tmp_path):
    journal = open_journal(tmp_path)
    write(journal, admission(3))
    journal.begin()
    journal.append(admission(2, first_seq=4), NOW_NS)
    journal.append(admission(2, machine="b"), NOW_NS)
    assert journal.last_row == 3
    journal.rollback()
    assert (journal.last_row, journal.marks()) == (1, {("a", 7): Mark(3)})
    assert [r.row for r in journal.read()] == [1]
    journal.close()


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


def test_a_failed_watermark_takes_its_row_with_it(tmp_path):
    journal = open_journal(tmp_path)
    journal._db.execute("CREATE TEMP TRIGGER full BEFORE INSERT ON watermark BEGIN SELECT RAISE(FAIL, 'full'); END")
    journal.begin()
    with pytest.raises(sqlite3.Error, match="full"):
        journal.append(admission(), NOW_NS)
    journal.rollback()
    assert (list(journal.read()), journal.marks(), journal.last_row) == ([], {}, 0)
    journal.close()


@pytest.mark.parametrize("offset", [0, 40, -1])
def test_a_damaged_row_is_detected(tmp_path, offset):
    journal = open_journal(tmp_path)
    write(journal, admission(), admission(first_seq=4), admission(first_seq=7))
    payload = bytearray(journal._db.execute("SELECT payload FROM journal WHERE row = 2").fetchone()[0])
    payload[offset] ^= 1
    journal._db.execute("UPDATE journal SET payload = ? WHERE row = 2", (bytes(payload),))
    with pytest.raises(StoreError, match=r"journal\.db: journal row 2 is damaged"):
        list(journal.read())
    assert [r.row for r in journal.read(after=2)] == [3]
    journal.close()


@pytest.mark.parametrize(
    ("site", "frame", "named"), [("quarry", SITE.frame, "site 'pit'"), ("pit", "00000000", f"frame '{SITE.frame}'")]
)
def test_the_store_of_another_site_is_refused(tmp_path, site, frame, named):
    open_journal(tmp_path).close()
    with pytest.raises(StoreError, match=rf"{named}.*choose another --store"):
        open_journal(tmp_path, site, frame)


def test_another_schema_is_refused(tmp_path):
    journal = open_journal(tmp_path)
    journal._db.execute("UPDATE meta SET value = '99' WHERE key = 'schema'")
    journal.close()
    with pytest.raises(StoreError, match="schema '99'"):
        open_journal(tmp_path)


def test_a_file_that_is_no_database_is_refused(tmp_path):
    (tmp_path / "journal.db").write_bytes(b"not a database at all" * 1000)
    with pytest.raises(StoreError, match="no usable journal"):
        open_journal(tmp_path)


def test_tables_and_their_names_are_made_in_one_transaction(tmp_path, monkeypatch):
    monkeypatch.setattr("mapserver.journal._TABLES", "CREATE TABLE meta (key, value, more); ")
    with pytest.raises(StoreError):
        open_journal(tmp_path)
    monkeypatch.undo()
    open_journal(tmp_path).close()  # nothing half-made was left behind


def test_reopening_continues_the_numbers(tmp_path):
    journal = open_journal(tmp_path)
    write(journal, admission(3), admission(2, first_seq=4))
    journal.close()
    journal = open_journal(tmp_path)
    assert (journal.last_row, journal.mark("a", 7)) == (2, Mark(5))
    write(journal, admission(2, first_seq=6))
    assert journal.last_row == 3
    journal.close()


def test_an_unknown_spool_has_no_progress(tmp_path):
    journal = open_journal(tmp_path)
    assert journal.mark("nobody", 1) == Mark(0, 0)
    assert (journal.last_row, journal.newest_ns(), list(journal.read())) == (0, 0, [])
    journal.close()


def test_lost_samples_are_summed_and_kept(tmp_path):
    journal = open_journal(tmp_path)
    write(journal, admission(3, lost=0))
    write(journal, admission(2, first_seq=10, lost=6), admission(1, first_seq=13, lost=1))
    journal.close()
    journal = open_journal(tmp_path)
    assert journal.mark("a", 7) == Mark(13, 7)
    journal.close()


def test_newest_stamp_is_that_of_all_rows(tmp_path):
    journal = open_journal(tmp_path)
    for first, stamps in ((1, [50, 90, 10]), (4, [60, 20, 30])):
        write(journal, Admission(batch(samples(3, stamp_ns=stamps), first), trimmed=0, lost=0))
    assert journal.newest_ns() == 90
    bounds = journal._db.execute("SELECT first_stamp_ns, last_stamp_ns FROM journal ORDER BY row").fetchall()
    assert bounds == [(10, 90), (20, 60)]
    journal.close()


def test_closing_folds_the_log_into_the_file(tmp_path):
    journal = open_journal(tmp_path)
    write(journal, admission(1000))
    assert (tmp_path / "journal.db-wal").stat().st_size > 0
    journal.close()
    assert not (tmp_path / "journal.db-wal").exists()
    copy = np.frombuffer((tmp_path / "journal.db").read_bytes(), np.uint8)
    assert len(copy) > 1000 * 64


def test_column_that_an_older_row_lacks_reads_as_nan():
    rows = np.ones(3, SAMPLE_DTYPE)
    older = msgpack.unpackb(journal_module._pack(rows))
    del older["grade_var"]
    found = journal_module._unpack(msgpack.packb(older))
    assert np.isnan(found["grade_var"]).all()
    assert (found["c_rr"] == 1).all()
