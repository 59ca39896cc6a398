"""Copies of stores: complete, consistent, verified; damage and gaps are named."""

from __future__ import annotations

import json
import os
import signal
import sqlite3
import subprocess
import sys
import time
from contextlib import ExitStack, closing
from pathlib import Path

import numpy as np
import pytest

from mapserver.config import ServerConfig
from mapserver.ingest.store import Incoming, Store
from mapserver.journal import archived_decisions
from mapserver.journal.archive import FOLDER, archive
from mapserver.journal.history import History, history_rows
from mapserver.journal.location import JOURNAL_FILE, JournalLocation
from mapserver.trust.decisions import PERSON, TrustDecision
from protocol.arrays import Table
from protocol.disk.high_water_mark import HighWaterMark, mark_path
from protocol.site.site_config import SiteConfig, site_toml
from protocol.units import HOUR_NS
from protocol.wire.codec import encode_batch
from protocol.wire.messages import Ack, SampleBatch
from sitegrid.backup import _making
from sitegrid.cli import main
from sitegrid.process.children import wait_until
from tests.patience import PATIENCE_S
from tests.unit.sitegrid.refold.archives import SITE, T0, samples

pytest.importorskip("pyarrow.parquet")
KILLS = 4


def rows_of(number: int) -> Table:
    return samples(np.random.default_rng(number), 20, days=0.1)


def send(store: Store, number: int, site: SiteConfig = SITE) -> None:
    rows = rows_of(number)
    sent = encode_batch(SampleBatch("a", 7, 20 * number + 1, rows, site.frame))
    (answer,) = store.commit([Incoming("a", sent)])
    assert isinstance(answer, Ack)


@pytest.fixture
def store(tmp_path: Path) -> Path:
    """Ten hourly batches, three archived."""
    folder, clock = tmp_path / "store", [T0]
    with closing(Store(JournalLocation(folder), SITE, ServerConfig(), lambda: clock[0])) as opened:
        for number in range(10):
            send(opened, number)
            clock[0] += HOUR_NS
        with JournalLocation(folder).reader() as reader:
            list(archive(folder / FOLDER, reader, SITE, T0 + 3 * HOUR_NS, opened.journal.forget))
    (folder / "site.toml").write_text(site_toml(SITE))
    return folder


def identities(folder: Path) -> list[tuple[object, ...]]:
    location = JournalLocation(folder)
    with location.reader() as reader:
        rows = history_rows(History(reader, location.archive))
        return [(r.row, r.machine, r.spool_id, r.first_seq, r.received_ns, r.rows.tobytes()) for r in rows]


def run(*words: object) -> int:
    return main([str(word) for word in words])


def refused(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    assert run(*words) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    return error


def test_a_backup_of_an_open_store_is_restored_with_all_that_it_had(store: Path, tmp_path: Path, capsys):
    with closing(Store(JournalLocation(store), SITE, ServerConfig(), time.time_ns)) as live:
        before = identities(store)
        assert run("backup", store, "--out", tmp_path / "copy", "--json") == 0
        send(live, 10)
        identity = live.identity
    examined = json.loads(capsys.readouterr().out)
    counts = ("rows", "samples", "lost", "events", "archive_files", "spools", "machines")
    assert tuple(examined[name] for name in counts) == (10, 200, 0, 0, 3, 1, 1)
    assert run("restore", tmp_path / "copy", "--out", tmp_path / "again") == 0
    assert identities(tmp_path / "again") == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["again", "copy", "store"]
    with closing(Store(JournalLocation(tmp_path / "again"), SITE, ServerConfig(), time.time_ns)) as restored:
        assert restored.identity == identity, "a copy is the same store"
        send(restored, 10)  # the machine resends what followed the backup
    assert run("verify", store) == 0
    assert "11 journal rows with 220 samples of 1 machines" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("damage", "problem"),
    [
        (lambda store: min((store / FOLDER).glob("*.parquet")).unlink(), "the file with row 1 is missing"),
        (lambda store: flip(max((store / FOLDER).glob("*.parquet"))), "is damaged"),
        (lambda store: (store / JOURNAL_FILE).unlink(), "holds no journal.db"),
        (lambda store: change(store, "UPDATE meta SET value = 'qit' WHERE key = 'site'"), "the site of the journal is"),
        (lambda store: decided(store) or change(store, "DELETE FROM events"), "what follows number 0 is damaged"),
    ],
)
def test_damage_is_named_by_verify_and_by_backup(store: Path, tmp_path: Path, capsys, damage, problem: str):
    damage(store)
    assert problem in refused(capsys, "verify", store)
    assert problem in refused(capsys, "backup", store, "--out", tmp_path / "copy")
    assert [path.name for path in tmp_path.iterdir()] == ["store"], "nothing half-made is left"


def change(store: Path, statement: str) -> None:
    with closing(sqlite3.connect(store / JOURNAL_FILE, isolation_level=None)) as db:
        db.execute(statement)


def decided(store: Path) -> None:
    """Add an event without updating the mark, as in a backup."""
    with closing(Store(JournalLocation(store), SITE, ServerConfig(), time.time_ns)) as opened:
        opened.decide(TrustDecision("a", False, PERSON, "drifts", T0))
    (store / f"{JOURNAL_FILE}-mark").unlink()


def flip(path: Path) -> None:
    """Flip a bit in the file's last samples."""
    data = bytearray(path.read_bytes())
    at = data.rfind(rows_of(9).tobytes()[:40])
    data[at + 20 if at >= 0 else len(data) // 3] ^= 4
    path.write_bytes(data)


def test_samples_beyond_a_watermark_are_named(store: Path, capsys):
    from mapserver.journal.rows import checksum

    values = ("a", (7).to_bytes(8, "big"), 199, 0, 5)
    with closing(sqlite3.connect(store / JOURNAL_FILE)) as db:
        db.execute("REPLACE INTO watermark VALUES (?, ?, ?, ?, ?, ?)", (*values, checksum(*values)))
        db.commit()
    (store / f"{JOURNAL_FILE}-mark").unlink()
    assert "has other samples of a, spool 0000000000000007, than its watermark says" in refused(capsys, "verify", store)


def test_a_store_that_lacks_what_was_acknowledged_is_not_copied_as_if_it_were_whole(
    store: Path, tmp_path: Path, capsys
):
    with closing(HighWaterMark(mark_path(store / JOURNAL_FILE))) as mark:
        mark.write({"a 0000000000000007": 240})
    for command in (("verify", store), ("backup", store, "--out", tmp_path / "copy")):
        error = refused(capsys, *command)
        assert "lacks what was acknowledged: 40 acknowledged samples of a are gone" in error
        assert "start a map server on it once" in error
    assert [path.name for path in tmp_path.iterdir()] == ["store"]
    Store(JournalLocation(store), SITE, ServerConfig(), time.time_ns).close()  # records the shortfall
    assert run("backup", store, "--out", tmp_path / "copy") == 0
    assert "1 events" in capsys.readouterr().out


@pytest.mark.parametrize("command", ["backup", "restore"])
def test_a_copy_is_on_the_disk_before_it_has_its_name(store: Path, tmp_path: Path, monkeypatch, command: str):
    archived_decisions.save(store / FOLDER, "0123456789abcdef", [])
    synced, fsync = set[str](), os.fsync

    def noted(descriptor: int) -> None:
        synced.add(str(Path(f"/proc/self/fd/{descriptor}").readlink()))
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", noted)
    assert run(command, store, "--out", tmp_path / "copy") == 0
    files = [path.relative_to(tmp_path / "copy") for path in (tmp_path / "copy").rglob("*")]
    assert len(files) >= 1 + 1 + 3 + 1
    assert {str(tmp_path / "copy.part" / path) for path in files} <= synced


def test_two_copies_to_one_place_do_not_meet(store: Path, tmp_path: Path, capsys):
    with _making(store, tmp_path / "copy") as (_, part):
        (part / "something").touch()
        assert "another process is at work there" in refused(capsys, "backup", store, "--out", tmp_path / "copy")
        assert (part / "something").exists()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["copy", "store"]


def test_a_place_that_is_taken_is_refused_and_a_live_store_is_no_backup(store: Path, tmp_path: Path, capsys):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "something").touch()
    for command in ("backup", "restore"):
        assert "exists and is not empty" in refused(capsys, command, store, "--out", tmp_path / "full")
    with closing(Store(JournalLocation(store), SITE, ServerConfig(), time.time_ns)):
        error = refused(capsys, "restore", store, "--out", tmp_path / "new")
        assert "is the store of a server that runs, and no backup" in error


SERVE = """
import sys, time
from pathlib import Path
from mapserver.config import ServerConfig
from mapserver.ingest.store import Store
from mapserver.journal.location import JournalLocation
from tests.unit.sitegrid.refold.archives import SITE
from tests.unit.sitegrid.test_backup import send
store = Store(JournalLocation(Path(sys.argv[1])), SITE, ServerConfig(), time.time_ns)
for number in range(10, 1_000_000):
    send(store, number)
    Path(sys.argv[2]).write_text(str(number))
"""


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.processes
def test_backups_that_are_killed_leave_no_backup_and_the_one_that_ends_has_all_that_was_acknowledged_before(
    store: Path, tmp_path: Path
):
    """A process commits constantly; backups are killed at random times."""
    draw = np.random.default_rng(1)
    noted = tmp_path / "acknowledged"
    with ExitStack() as ending:
        live = ending.enter_context(subprocess.Popen([sys.executable, "-c", SERVE, str(store), str(noted)]))
        ending.callback(live.kill)
        wait_until(lambda: noted.exists() and noted.read_text() != "", PATIENCE_S, "the first batch")
        words = ("backup", str(store), "--out", str(tmp_path / "copy"), "--json")
        command = [sys.executable, "-m", "sitegrid.cli", *words]
        killed = 0
        for _ in range(KILLS):
            with subprocess.Popen(command, stdout=subprocess.DEVNULL) as copier:
                try:
                    copier.wait(float(draw.uniform(0.3, 1.5)))
                except subprocess.TimeoutExpired:
                    os.kill(copier.pid, signal.SIGKILL)
                    killed += 1
            if (tmp_path / "copy").exists():  # complete, even if killed afterwards
                assert run("verify", tmp_path / "copy") == 0
                (tmp_path / "copy").rename(tmp_path / f"copy-{copier.pid}")
        wait_until(lambda: noted.read_text() != "", PATIENCE_S, "a whole note")
        acknowledged = int(noted.read_text() or 10)
        assert run("backup", store, "--out", tmp_path / "copy") == 0
        assert live.poll() is None, "it went on all the time"
    assert killed, "in the middle"
    assert not (tmp_path / "copy.part").exists()
    assert run("restore", tmp_path / "copy", "--out", tmp_path / "again") == 0
    rows = identities(tmp_path / "again")
    assert [row[0] for row in rows] == list(range(1, len(rows) + 1))
    assert len(rows) >= acknowledged + 1, "nothing that was acknowledged before is missing"
    assert rows == identities(store)[: len(rows)]
