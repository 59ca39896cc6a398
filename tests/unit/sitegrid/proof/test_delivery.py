import shutil
import sqlite3
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from agents.delivery.audit import AuditLog
from mapserver.config import ServerConfig
from mapserver.evidence.grid import Grid
from mapserver.ingest.store import Incoming, Store
from mapserver.journal.archive import FOLDER, archive
from mapserver.journal.location import JOURNAL_FILE, JournalLocation
from mapserver.journal.records import record
from mapserver.journal.rows import JournalRow
from mapserver.journal.sqlite.journal import SqliteJournal
from mapserver.journal.sqlite.reader import SqliteReader
from mapserver.trust.decisions import KIND, PERSON, TrustDecision
from protocol.arrays import Table
from protocol.machine.samples import content_hash, empty
from protocol.site.site_config import SiteConfig
from protocol.wire.codec import encode_batch
from protocol.wire.messages import Ack, SampleBatch
from sitegrid.proof.delivery import AuditResult, audit_store, compare, grid_difference, read_audits

SITE, CONFIG = SiteConfig("pit", 48.0, 11.0), ServerConfig()
SPOOLS = {"a": 2**63 + 5, "b": 9}
N, BATCH = 60, 10
CLEAN = AuditResult(recorded=2 * N, merged=2 * N, lost=0, double=0, unrecorded=0)


def recorded_rows(seed: int) -> Table:
    draw, rows = np.random.default_rng(seed), empty(N)
    rows["stamp_ns"] = 1_767_225_600_000_000_000 + np.arange(N) * 10**9
    rows["x_m"], rows["y_m"] = draw.uniform(-40, 40, (2, N))
    rows["cov_xx_m2"] = rows["cov_yy_m2"] = draw.uniform(0.1, 2.0, N)
    rows["cov_xx_m2"][::20] = 25.0  # too uncertain to vote
    rows["distance_m"], rows["c_rr"] = draw.uniform(0.5, 1.5, N), draw.uniform(0.005, 0.3, N)
    return rows


@pytest.fixture(scope="module")
def clean(tmp_path_factory) -> tuple[Path, dict[str, Path]]:
    """Store and audit files of a faultless run."""
    folder = tmp_path_factory.mktemp("run")
    store, audits = Store(JournalLocation(folder / "store"), SITE, CONFIG, time.time_ns), {}
    for seed, (machine, spool) in enumerate(SPOOLS.items()):
        rows, audits[machine] = recorded_rows(seed), folder / f"{machine}.audit"
        log = AuditLog(audits[machine])
        log.recorded(spool, 1, rows)
        log.close()
        for first in range(0, N, BATCH):
            # batches overlap: trimmed, not counted twice
            start = max(0, first - 3)
            batch = SampleBatch(machine, spool, start + 1, rows[start : first + BATCH], SITE.frame)
            assert isinstance(store.commit([Incoming(machine, encode_batch(batch))])[0], Ack)
    store.save_snapshot()
    store.close()
    return folder / "store", audits


@pytest.fixture
def folder(clean, tmp_path) -> Path:
    return Path(shutil.copytree(clean[0], tmp_path / "store"))


@pytest.fixture
def run(clean, folder) -> Callable[..., AuditResult]:
    """Audit a store after changing its journal by statements or rows."""

    def audit(*changes: str | JournalRow) -> AuditResult:
        with closing(sqlite3.connect(folder / JOURNAL_FILE)) as db, db:
            for change in changes:
                if isinstance(change, JournalRow):
                    db.execute("REPLACE INTO journal VALUES (?, ?)", (change.row, record(change)))
                else:
                    db.execute(change)
        return audit_store(clean[1], folder, SITE, CONFIG)

    return audit


@pytest.fixture
def journal(clean) -> list[JournalRow]:
    with SqliteReader(clean[0] / JOURNAL_FILE) as reader:
        return list(reader.read())


def grid_of(rows: list[JournalRow]) -> Grid:
    grid = Grid(SITE.cell_m, CONFIG.fold)
    for row in rows:
        grid.fold(row.rows, row.machine)
    return grid


def test_a_clean_run_has_nothing_lost_and_nothing_double(run):
    assert run() == CLEAN


def test_samples_dropped_from_a_row_are_lost(run, journal):
    result = run(replace(journal[3], rows=journal[3].rows[:1]))
    assert result.lost == BATCH - 1
    assert result.double > 0  # votes without journal rows
    assert result.unrecorded == 0


@pytest.mark.parametrize(("spool", "unrecorded"), [({}, 0), ({"spool_id": 1}, BATCH)])
def test_a_row_repeated_in_the_journal_is_double_by_its_content_under_any_identity(run, journal, spool, unrecorded):
    result = run(replace(journal[3], row=len(journal) + 1, **spool))
    assert result.double >= BATCH
    assert result.unrecorded == unrecorded


def test_a_row_of_another_machine_is_not_recorded(run, journal):
    assert run(replace(journal[3], row=len(journal) + 1, machine="c")).unrecorded == BATCH


def audit_of(clean, journal, grid=None) -> AuditResult:
    return compare(read_audits(clean[1]), journal, grid or grid_of(journal), SITE, CONFIG)


@pytest.mark.parametrize("field", ["stamp_ns", "x_m", "c_rr", "grade_var"])
def test_a_sample_whose_content_changed_is_lost(clean, journal, field):
    changed = journal[2].rows.copy()
    changed[field][5] += 1
    rows = [*journal[:2], replace(journal[2], rows=changed), *journal[3:]]
    assert audit_of(clean, rows) == replace(CLEAN, lost=1)


def test_samples_in_the_wrong_order_are_lost(clean, journal):
    rows = [replace(journal[0], rows=journal[0].rows[::-1]), *journal[1:]]
    assert audit_of(clean, rows).lost == BATCH


def test_a_grid_without_one_row_has_lost_it(clean, journal):
    result = audit_of(clean, journal, grid_of(journal[:3] + journal[4:]))
    assert (result.double, result.merged) == (0, 2 * N - BATCH)
    assert result.lost == pytest.approx(BATCH, abs=5)


def test_a_grid_with_a_row_twice_has_doubles(clean, journal):
    result = audit_of(clean, journal, grid_of([*journal, journal[3]]))
    assert (result.lost, result.merged) == (0, 2 * N + BATCH)
    assert result.double == pytest.approx(BATCH, abs=5)


def test_a_grid_without_one_sample_of_a_few_centimetres_has_lost_it(clean, journal):
    rows = journal[1].rows.copy()
    rows["distance_m"][3] -= 0.02
    grid = grid_of([journal[0], replace(journal[1], rows=rows), *journal[2:]])
    assert audit_of(clean, journal, grid).lost == 1


def test_a_sample_never_sent_is_lost(clean, journal, tmp_path):
    more = tmp_path / "a.audit"
    shutil.copy(clean[1]["a"], more)
    log = AuditLog(more)
    log.recorded(SPOOLS["a"], N + 1, recorded_rows(9)[:4])
    log.close()
    result = compare(read_audits({**clean[1], "a": more}), journal, grid_of(journal), SITE, CONFIG)
    assert result == replace(CLEAN, recorded=2 * N + 4, lost=4)


def test_renumbered_samples_count_once_under_their_new_identity(clean, journal, tmp_path):
    rows = recorded_rows(3)[:2]
    log = AuditLog(tmp_path / "c.audit")
    log.recorded(5, 1, rows)
    log.renumbered(5, [1, 2], 6, rows)
    log.close()
    recorded = read_audits({"c": tmp_path / "c.audit"})
    assert recorded == {("c", 6, i + 1): (content_hash(row),) for i, row in enumerate(rows)}


def test_pages_that_were_summed_by_age_are_compared_too(journal):
    aged = []
    for i, row in enumerate(journal):
        rows = row.rows.copy()
        rows["x_m"], rows["y_m"] = 8.5, 8.5  # merging is decided by cell
        rows["stamp_ns"] += i * 5 * 3600 * 10**9
        aged.append(replace(row, rows=rows))
    whole, less = grid_of(aged).state(), grid_of(aged[1:]).state()
    assert {at.tier for at in whole.pages} >= {0, 1}
    assert grid_difference(whole, whole) == (0, 0)
    assert grid_difference(whole, less) == (pytest.approx(BATCH, abs=5), 0)


def test_a_machine_that_is_left_out_of_the_map_has_lost_nothing(clean, folder):
    store = Store(JournalLocation(folder), SITE, CONFIG, time.time_ns)
    store.journal.append_event(KIND, 1, asdict(TrustDecision("b", trusted=False, by=PERSON, reason="test", stamp_ns=1)))
    store.close()
    store = Store(JournalLocation(folder), SITE, CONFIG, time.time_ns)
    assert store.facts.excluded == {"b"}
    store.save_snapshot()
    store.close()
    result = audit_store(clean[1], folder, SITE, CONFIG)
    assert (result.lost, result.double, result.unrecorded) == (0, 0, 0)


def test_rows_that_are_archived_are_not_lost(clean, folder):
    writer = SqliteJournal(folder / JOURNAL_FILE, SITE.name, SITE.frame)
    with SqliteReader(folder / JOURNAL_FILE) as reader:
        assert list(archive(folder / FOLDER, reader, SITE, 2**62, writer.forget))
    writer.close()
    assert audit_store(clean[1], folder, SITE, CONFIG) == CLEAN
