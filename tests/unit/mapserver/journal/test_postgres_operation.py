"""Operators' work on a journal in PostgreSQL: dumps, base backups, restores."""

from __future__ import annotations

import subprocess
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager

import pytest

from mapserver.ingest.store import Store
from mapserver.journal.location import JournalLocation
from protocol.wire.messages import Ack
from tests import postgres_server as server
from tests.postgres_server import Cluster, Database
from tests.unit.mapserver.data import CONFIG, NOW_NS, SITE, incoming, random_samples, same, wait_for
from tests.unit.mapserver.journal.test_postgres import folded_by, open_store, place, send

MANY = 2000  # per row, so a dump exceeds a pipe


def fill(store: Store, machine: str, rows: int) -> None:
    batches = [incoming(random_samples(MANY, n), 1 + n * MANY, machine) for n in range(rows)]
    assert all(isinstance(answer, Ack) for answer in store.commit(batches))


@contextmanager
def dumping(database: Database) -> Iterator[subprocess.Popen[bytes]]:
    """A real dump blocked by its full pipe."""
    words = [str(server.binaries() / "pg_dump"), "--format=plain", f"--dbname={database.url}"]
    with subprocess.Popen(words, stdout=subprocess.PIPE) as dump:
        try:
            dumps = "application_name = 'pg_dump' AND query LIKE 'COPY sitegrid.journal%'"
            wait_for(lambda: bool(database.sql(f"SELECT 1 FROM pg_stat_activity WHERE {dumps}")))
            yield dump
        finally:
            dump.kill()


def restored_from(text: bytes, cluster: Cluster) -> Database:
    database = cluster.new_database()
    words = [str(server.binaries() / "psql"), "--quiet", "--set=ON_ERROR_STOP=1", f"--dbname={database.url}"]
    done = subprocess.run(words, input=text, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr
    return database


@pytest.mark.slow
def test_a_real_dump_holds_neither_writer_nor_follower_up_and_is_a_backup(tmp_path, database):
    with closing(open_store(tmp_path, database)) as store, place(tmp_path, database).reader() as reader:
        fill(store, "b", 16)
        send(store, 1)
        before = reader.state()
        with dumping(database) as dump:
            assert isinstance(send(store, 6), Ack)
            assert reader.follow(before, 5.0).row == before.row + 1
            assert store.journal.forget(3) == 3
            text, _ = dump.communicate()
        assert dump.returncode == 0
        assert reader.archived_row == 3
    copy = restored_from(text, database.cluster)
    # A server with the old database's folder knows later acknowledgements; machines resend.
    with closing(open_store(tmp_path, copy)) as store:
        assert "5 acknowledged samples of a are gone" in str(store.shortfalls[0])
        assert (store.journalled, store.journal.archived_row) == (before.row, 0), "as it was when the dump began"
        assert store.journal.epoch == 2
        assert same(store.grid, folded_by(store))
        assert send(store, 6).watermark == 10


@pytest.mark.nightly
def test_a_base_backup_of_a_live_primary_has_what_was_acknowledged_before_it_began(tmp_path):
    with server.cluster() as primary, server.cluster_folder() as folder:
        database, copy = primary.new_database(), Cluster(folder)
        with closing(open_store(tmp_path / "one", database)) as store:
            for first in (1, 6):
                send(store, first)
            ending, sent = threading.Event(), 0

            def work() -> None:
                nonlocal sent
                while not ending.is_set() and isinstance(send(store, 1 + sent, machine="b"), Ack):
                    sent += 5

            working = threading.Thread(target=work)
            working.start()
            try:
                copy.copy_of(primary, "backup")
            finally:
                ending.set()
                working.join()
            assert sent > 0
        (copy.data / "standby.signal").unlink()  # becomes a primary
        copy.start()
        try:
            at = JournalLocation(tmp_path / "one", copy.url(database.name))
            with closing(Store(at, SITE, CONFIG, lambda: NOW_NS)) as restored:
                assert restored.journal.watermark("a", 7).seq == 10
                assert same(restored.grid, folded_by(restored))
                behind = sent - restored.journal.watermark("b", 7).seq
                assert bool(restored.shortfalls) == (behind > 0), "what came after it is named"
        finally:
            copy.stop()
