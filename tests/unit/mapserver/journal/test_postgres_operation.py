"""What operators do to a journal in PostgreSQL: dumps, base backups, cancelled waits; by PostgreSQL's own programs."""

from __future__ import annotations

import os
import signal
import subprocess
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest

from mapserver.ingest.store import Store
from mapserver.journal.location import JournalLocation
from protocol.errors import Refusal
from protocol.wire.messages import Ack, Refused
from tests import postgres_server as server
from tests.postgres_server import Cluster, Database
from tests.unit.mapserver.data import CONFIG, NOW_NS, SITE, incoming, random_samples, same, wait_for
from tests.unit.mapserver.journal.test_postgres import folded_by, open_store, place, send, synchronous_pair

MANY = 2000  # samples of a row, so that a dump is more than what a pipe holds


def fill(store: Store, machine: str, rows: int) -> None:
    """Rows that a dump needs a while for."""
    batches = [incoming(random_samples(MANY, n), 1 + n * MANY, machine) for n in range(rows)]
    assert all(isinstance(answer, Ack) for answer in store.commit(batches))


@contextmanager
def dumping(database: Database) -> Iterator[subprocess.Popen[bytes]]:
    """A real dump that does not get on, since nobody takes what it writes."""
    words = [str(server.binaries() / "pg_dump"), "--format=plain", f"--dbname={database.url}"]
    with subprocess.Popen(words, stdout=subprocess.PIPE) as dump:
        try:
            dumps = "application_name = 'pg_dump' AND query LIKE 'COPY sitegrid.journal%'"
            wait_for(lambda: bool(database.sql(f"SELECT 1 FROM pg_stat_activity WHERE {dumps}")))
            yield dump
        finally:
            dump.kill()


def restored_from(text: bytes, cluster: Cluster) -> Database:
    """A new database with what a dump holds."""
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
    # A server with the folder of the old database knows what was acknowledged since; machines send it again.
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
        (copy.data / "standby.signal").unlink()  # it is to be a primary
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


@pytest.mark.nightly
def test_a_commit_that_an_operator_stops_from_waiting_for_its_replica_is_not_acknowledged(tmp_path):
    with synchronous_pair() as (primary, replica):
        for end in ("pg_cancel_backend", "pg_terminate_backend"):
            stops_waiting(tmp_path / end, primary, replica, end)


def stops_waiting(folder: Path, primary: Cluster, replica: Cluster, end: str) -> None:
    """An operator ends the wait of a commit for a replica that hangs."""
    database = primary.new_database()
    with closing(open_store(folder, database)) as store:
        assert isinstance(send(store, 1), Ack)
        with stopped(replica):
            answers: list[Ack | Refused] = []
            waiting = threading.Thread(target=lambda: answers.append(send(store, 6)), daemon=True)
            waiting.start()
            waits = "application_name = 'sitegrid writer' AND wait_event = 'SyncRep'"
            wait_for(lambda: bool(primary.sql(f"SELECT 1 FROM pg_stat_activity WHERE {waits}")))
            primary.sql(f"SELECT {end}(pid) FROM pg_stat_activity WHERE {waits}")
            waiting.join(20.0)
            assert [answer.reason for answer in answers] == [Refusal.STORE]
            count = "SELECT count(*) FROM sitegrid.journal"
            assert database.sql(count) == [(2,)], "it is there, but on this host alone"

            # The same again is not acknowledged either, until the replica has both.
            again = threading.Thread(target=lambda: answers.append(send(store, 6)), daemon=True)
            again.start()
            again.join(2.0)
            assert not any(isinstance(answer, Ack) for answer in answers)
        again.join(20.0)
        wait_for(lambda: isinstance(send(store, 6), Ack))
        wait_for(lambda: replica.shows_all_of(primary))
        assert Database(replica, database.name).sql(count) == [(2,)]
        assert store.journal.watermark("a", 7).seq == 10
        assert same(store.grid, folded_by(store))


@contextmanager
def stopped(cluster: Cluster) -> Iterator[None]:
    """A server whose processes are stopped, as on a host that hangs."""
    pids = processes_of(cluster)
    for pid in pids:
        os.kill(pid, signal.SIGSTOP)
    try:
        yield
    finally:
        for pid in pids:
            os.kill(pid, signal.SIGCONT)


def processes_of(cluster: Cluster) -> list[int]:
    """Ids of a server's processes."""
    main = (cluster.data / "postmaster.pid").read_text().split()[0]
    return [int(pid) for pid in (main, *Path(f"/proc/{main}/task/{main}/children").read_text().split())]
