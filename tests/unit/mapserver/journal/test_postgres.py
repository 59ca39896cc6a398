"""A journal in PostgreSQL beyond the contract: refusals, loss of the lock, restores."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import psycopg
import pytest

from mapserver.evidence.grid import Grid
from mapserver.ingest.standby import Standby
from mapserver.ingest.store import Store
from mapserver.ingest.writer import Writer
from mapserver.journal.history import history_rows
from mapserver.journal.journal import FencedError
from mapserver.journal.location import JournalLocation
from mapserver.journal.postgres import session
from mapserver.journal.postgres.connection import shown
from mapserver.journal.postgres.session import WriterSession
from mapserver.past.checkpoints import snapshot_rows
from mapserver.trust.decisions import PERSON, TrustDecision
from mapserver.upkeep.refolding import Refolding
from protocol.errors import ConfigError, QueryError, Refusal, SitegridError, StoreError
from protocol.wire.messages import Ack, Refused
from tests import postgres_server as server
from tests.postgres_server import Cluster, Database
from tests.tcp_proxy import Proxy, Weather
from tests.unit.mapserver.data import CONFIG, SITE, fold_of, incoming, now_ns, past_of, random_samples, same, wait_for


def place(folder: Path, database: Database) -> JournalLocation:
    return JournalLocation(folder, database.url)


def open_store(folder: Path, database: Database, standby: Standby | None = None) -> Store:
    return Store(place(folder, database), SITE, CONFIG, now_ns, standby=standby)


def after_waiting(folder: Path, database: Database) -> Store:
    with closing(Standby(place(folder, database), SITE, CONFIG, bool)) as standby:
        return open_store(folder, database, standby)


def send(store: Store, first: int, count: int = 5, machine: str = "a") -> Ack | Refused:
    return store.commit([incoming(random_samples(count, first), first, machine)])[0]


def hang(store: Store) -> None:
    """Silence the holder of the lock, like a stopped process."""
    store.journal._session._ending.set()


@pytest.mark.parametrize(
    ("url", "problem"),
    [
        ("postgresql://127.0.0.1:1/x", "cannot be read: connection.*refused"),
        ("postgresql://[", "--journal: is no PostgreSQL URL"),
        ("postgresql://host/db?nonsense=1", "--journal: is no PostgreSQL URL"),
        ("", 'database "nothing" does not exist'),
    ],
)
def test_a_url_that_leads_nowhere_is_one_line(tmp_path, postgres_cluster, url, problem):
    with pytest.raises(SitegridError, match=problem) as caught:
        JournalLocation(tmp_path, url or postgres_cluster.url("nothing")).exists()
    assert "\n" not in str(caught.value)


def test_a_password_is_never_shown():
    url = "postgresql://me:secret@one,two:5433/map?target_session_attrs=any"
    assert shown(url) == "postgresql://me@one,two:5433/map"


def test_without_the_extra_one_line_says_what_to_install(tmp_path, monkeypatch):
    for name in [name for name in sys.modules if name.startswith("mapserver.journal.postgres.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "psycopg", None)
    for name in ("connection", "journal", "mark", "reader"):
        monkeypatch.delattr(f"mapserver.journal.postgres.{name}", raising=False)
    with pytest.raises(ConfigError, match=r"pip install '\.\[postgres\]'"):
        JournalLocation(tmp_path, "postgresql://localhost/x").exists()


@pytest.mark.slow
def test_a_database_that_may_lose_commits_is_refused(tmp_path):
    with server.cluster() as cluster:
        database = cluster.new_database()
        for name in ("fsync", "full_page_writes"):
            cluster.sql(f"ALTER SYSTEM SET {name} = off")
            cluster.sql("SELECT pg_reload_conf()")
            wait_for(lambda name=name: cluster.sql(f"SHOW {name}") == [("off",)])
            with pytest.raises(StoreError, match=f"{name} = off.*turn it on"):
                open_store(tmp_path, database)
            cluster.sql(f"ALTER SYSTEM RESET {name}")
            cluster.sql("SELECT pg_reload_conf()")
            wait_for(lambda name=name: cluster.sql(f"SHOW {name}") == [("on",)])
        open_store(tmp_path, database).close()


def test_commits_are_synchronous_whatever_the_database_says(tmp_path, database):
    database.sql(f"ALTER DATABASE {database.name} SET synchronous_commit = off")
    with closing(open_store(tmp_path, database)) as store:
        assert store.journal._session.run("SHOW synchronous_commit") == [("on",)]


def test_a_folder_is_of_one_journal(tmp_path, database, postgres_cluster):
    open_store(tmp_path / "one", database).close()
    other = postgres_cluster.new_database()
    with pytest.raises(StoreError, match=r"holds no journal, and .*one is of journal .* choose another --store"):
        open_store(tmp_path / "one", other)
    open_store(tmp_path / "other", other).close()
    with pytest.raises(StoreError, match=r"belongs to journal .* choose another --store"):
        open_store(tmp_path / "one", other)
    with pytest.raises(ConfigError, match="give its --journal"):
        Store(JournalLocation(tmp_path / "one"), SITE, CONFIG, now_ns)
    Store(JournalLocation(tmp_path / "two"), SITE, CONFIG, now_ns).close()
    with pytest.raises(ConfigError, match=r"journal\.db of its own"):
        open_store(tmp_path / "two", database)


def test_limits_that_a_database_has_for_others_are_not_for_a_server(tmp_path, database):
    for name in ("idle_session_timeout", "statement_timeout", "lock_timeout"):
        database.sql(f"ALTER DATABASE {database.name} SET {name} = '500ms'")
    with closing(open_store(tmp_path, database)), place(tmp_path, database).reader() as reader:
        for name in ("idle_session_timeout", "statement_timeout", "lock_timeout"):
            assert reader._query(f"SHOW {name}") == [("0",)]


def test_a_holder_that_says_nothing_loses_the_lock_by_itself(tmp_path, database):
    with closing(open_store(tmp_path / "one", database)) as first:
        assert send(first, 1).epoch == 1
        hang(first)
        with closing(after_waiting(tmp_path / "two", database)) as second:
            assert isinstance(send(first, 6), Refused), "its session is gone, and it does not know yet"
            with pytest.raises(FencedError, match="another server has taken over the journal, with epoch 2 after 1"):
                send(first, 6)
            answer = send(second, 6)
            assert (answer.watermark, answer.epoch) == (10, 2)
            assert same(second.grid, folded_by(second))


def folded_by(store: Store) -> Grid:
    return fold_of(history_rows(store.history))


def test_a_holder_whose_network_swallows_all_bytes_notices_it(tmp_path, database):
    """A proxy acknowledges them, so the kernel waits for ever."""
    with Proxy(database.cluster.port) as proxy:
        url = database.url.replace(str(database.cluster.port), proxy.endpoint.rpartition(":")[2])
        store = Store(JournalLocation(tmp_path / "one", url), SITE, CONFIG, now_ns)
        assert send(store, 1).epoch == 1
        proxy.set(Weather(hold_there=True, hold_back=True))
        with closing(after_waiting(tmp_path / "two", database)) as second:
            wait_for(lambda: store.journal._session.lost)
            assert isinstance(send(store, 6), Refused), "and no thread waits for ever"
            assert send(second, 6).epoch == 2
            store.close()


def test_a_commit_whose_answer_never_comes_ends_once_another_server_has_taken_over(tmp_path, database):
    with Proxy(database.cluster.port) as proxy, Proxy(database.cluster.port) as open_proxy:
        url = database.url.replace(str(database.cluster.port), proxy.endpoint.rpartition(":")[2])
        with closing(Store(JournalLocation(tmp_path / "one", url), SITE, CONFIG, now_ns)) as store:
            send(store, 1)
            proxy.set(Weather(hold_back=True))
            store.journal._url = url.replace(proxy.endpoint.rpartition(":")[2], open_proxy.endpoint.rpartition(":")[2])
            answers: list[object] = []

            def commit() -> None:
                try:
                    answers.append(send(store, 6))
                except FencedError as error:
                    answers.append(error)

            committing = threading.Thread(target=commit)
            committing.start()
            with closing(after_waiting(tmp_path / "two", database)) as second:
                committing.join(20.0)
                assert len(answers) == 1
                assert not isinstance(answers[0], Ack)
                wait_for(lambda: "taken over the journal, with epoch 2 after 1" in store.journal.fenced)
                assert send(second, 6).trimmed == 5, "it was committed, and nobody was told so"


def test_a_holder_that_works_keeps_the_lock(tmp_path, database):
    with closing(open_store(tmp_path, database)) as store:
        end_s = time.monotonic() + 2 * session.HANGS_S
        with closing(WriterSession(database.url, "there")) as other:
            wait_for(lambda: other.take_lock() or time.monotonic() > end_s)
        assert not store.journal._session.lost
        assert send(store, 1).epoch == 1


def test_a_writer_without_its_lock_cannot_commit(tmp_path, database):
    """Only the epoch fences it: its session lives. Even its own rows are not acknowledged again."""
    for had in (1, 2):
        with closing(open_store(tmp_path, database)) as store:
            if had == 1:
                assert isinstance(send(store, 1), Ack)
            database.sql("UPDATE sitegrid.head SET epoch = epoch + 1")
            with pytest.raises(FencedError):
                send(store, 1 if had == 1 else 6)
            assert store.journal.fenced
            with pytest.raises(FencedError):
                store.commit([incoming(random_samples(0, 1), 1)])
        assert database.sql("SELECT count(*) FROM sitegrid.journal") == [(1,)]


class LostAnswer:
    """Cuts a session once, between a statement with some text and its answer."""

    def __init__(self, session: WriterSession, text: str) -> None:
        self._db, self._text = session._db, text
        session._db = self

    def __getattr__(self, name: str) -> Any:
        return getattr(self._db, name)

    def execute(self, query: Any, *more: Any) -> Any:
        answer = self._db.execute(query, *more)
        if self._text in (query.decode() if isinstance(query, bytes) else query):
            self._db.close()
            raise psycopg.OperationalError("server closed the connection unexpectedly")
        return answer


def test_a_decision_whose_answer_is_lost_is_not_called_refused(tmp_path, database):
    writer = Writer(open_store(tmp_path, database))
    with closing(writer), closing(Refolding(writer, past_of(writer))) as refolding:
        LostAnswer(writer._store.journal._session, "INSERT INTO events")
        with pytest.raises(QueryError, match=r"not known whether the decision is kept.*ask for") as caught:
            refolding.decide(TrustDecision("b", False, PERSON, "it lies", 1))
        assert caught.value.reason == Refusal.AFTER_TIMEOUT
        with pytest.raises(
            QueryError, match="is not written: a decision was committed whose answer was lost"
        ) as caught:
            refolding.decide(TrustDecision("c", False, PERSON, "it lies", 1))
        assert caught.value.reason == Refusal.NOT_WRITER
    with closing(open_store(tmp_path, database)) as store:
        assert store.facts.excluded == {"b"}


def test_an_epoch_whose_answer_is_lost_is_not_taken_for_another_server(tmp_path, database, monkeypatch):
    with closing(open_store(tmp_path, database)) as store:
        assert send(store, 1).epoch == 1
        real = WriterSession.take_lock
        monkeypatch.setattr(WriterSession, "take_lock", lambda self: (LostAnswer(self, "SET epoch"), real(self))[1])
        database.end_writer()
        assert isinstance(send(store, 6), Refused)
        assert isinstance(send(store, 6), Refused)
        assert database.sql("SELECT epoch FROM sitegrid.head") == [(2,)]
        monkeypatch.undo()
        answer = send(store, 6)
        assert (answer.watermark, answer.epoch) == (10, 3)
        assert same(store.grid, folded_by(store))


@pytest.mark.parametrize("end", [Database.end_writer, Database.end_all])
def test_a_server_goes_on_after_its_sessions_were_ended(tmp_path, database, end):
    with closing(open_store(tmp_path, database)) as store:
        assert send(store, 1).epoch == 1
        end(database)
        answers = [send(store, 6), send(store, 6)]
        assert isinstance(answers[0], Refused)
        assert (answers[1].epoch, answers[1].watermark) == (2, 10)
        assert same(store.grid, folded_by(store))


def test_servers_that_start_at_once_on_an_empty_database_have_one_journal(tmp_path, database):
    """Each knows its id before asking who else serves the site, else the later would take it for another."""
    places = [place(tmp_path / str(n), database) for n in range(8)]
    with ThreadPoolExecutor(len(places)) as threads:
        ids = list(threads.map(lambda one: one.prepared_id(SITE.name, SITE.frame), places))
    assert ids == [places[0].store_id()] * len(places)
    assert len(ids[0]) == 16
    assert database.sql("SELECT epoch, last_row FROM sitegrid.head") == [(0, 0)]
    with closing(open_store(tmp_path / "0", database)) as store:
        assert send(store, 1).epoch == 1


def test_a_second_server_is_refused_where_it_may_not_wait(tmp_path, database):
    with closing(open_store(tmp_path / "one", database)), pytest.raises(StoreError, match="another server is writing"):
        open_store(tmp_path / "two", database)


@pytest.fixture
def restored(tmp_path: Path, database: Database) -> Iterator[Database]:
    """A database without two of three batches acknowledged by server `one`; `two` wrote since."""
    with closing(open_store(tmp_path / "one", database)) as store:
        send(store, 1)
    cluster = database.cluster
    cluster.sql(f"CREATE DATABASE backup_{database.name} TEMPLATE {database.name}")
    with closing(open_store(tmp_path / "one", database)) as store:
        send(store, 6)
        send(store, 11)
        store.save_snapshot()
    cluster.sql(f"DROP DATABASE {database.name}")
    cluster.sql(f"ALTER DATABASE backup_{database.name} RENAME TO {database.name}")
    return database


def test_rows_that_a_restore_takes_away_are_named_and_asked_for_again(tmp_path, restored):
    with closing(open_store(tmp_path / "one", restored)) as store:
        assert "10 acknowledged samples of a are gone" in str(store.shortfalls[0])
        assert store.journal.epoch == 3, "beyond the epoch that the backup does not know"
        assert snapshot_rows(tmp_path / "one") == []
        assert same(store.grid, folded_by(store))
        assert send(store, 6).watermark == 10


def test_a_snapshot_of_rows_that_went_another_course_is_not_used(tmp_path, restored):
    with closing(open_store(tmp_path / "two", restored)) as store:
        for first in (1, 6, 11):
            send(store, first, machine="b")
    with closing(open_store(tmp_path / "one", restored)) as store:
        assert store.journalled == 4, "more rows than the snapshot of the third has"
        assert same(store.grid, folded_by(store))


def test_a_server_that_runs_while_its_database_is_restored_ends(tmp_path, database):
    cluster = database.cluster
    open_store(tmp_path, database).close()
    cluster.sql(f"CREATE DATABASE backup_{database.name} TEMPLATE {database.name}")
    with closing(open_store(tmp_path, database)) as store:
        send(store, 1)
        cluster.sql(f"DROP DATABASE {database.name} WITH (FORCE)")
        cluster.sql(f"ALTER DATABASE backup_{database.name} RENAME TO {database.name}")
        wait_for(lambda: store.journal._session.lost)
        with pytest.raises(FencedError, match="lacks rows that were acknowledged"):
            send(store, 6)


@contextmanager
def synchronous_pair() -> Iterator[tuple[Cluster, Cluster]]:
    with server.cluster() as primary, server.replica(primary, "b") as replica:
        primary.sql("ALTER SYSTEM SET synchronous_standby_names = 'b'")
        primary.sql("SELECT pg_reload_conf()")
        wait_for(lambda: primary.sql("SELECT sync_state FROM pg_stat_replication") == [("sync",)])
        yield primary, replica


def test_a_long_dump_holds_nobody_up(tmp_path, database):
    with closing(open_store(tmp_path, database)) as store, place(tmp_path, database).reader() as reader:
        send(store, 1)
        with psycopg.connect(database.url) as dump:
            dump.execute("SET TRANSACTION ISOLATION LEVEL REPEATABLE READ READ ONLY")
            assert dump.execute("SELECT count(*) FROM sitegrid.journal").fetchone() == (1,)
            assert isinstance(send(store, 6), Ack)
            assert store.journal.forget(1) == 1
            assert reader.follow(reader.state(), 0.0).row == 2
            assert [row.row for row in reader.read(1)] == [2]
            assert dump.execute("SELECT count(*) FROM sitegrid.journal").fetchone() == (1,), "its own time"


@pytest.mark.nightly
def test_a_commit_that_an_operator_stops_from_waiting_for_its_replica_is_not_acknowledged(tmp_path):
    with synchronous_pair() as (primary, replica):
        database = primary.new_database()
        with closing(open_store(tmp_path, database)) as store:
            assert isinstance(send(store, 1), Ack)
            with stopped(replica), ThreadPoolExecutor() as threads:
                waiting = threads.submit(send, store, 6)
                waits = "application_name = 'sitegrid writer' AND wait_event = 'SyncRep'"
                wait_for(lambda: bool(primary.sql(f"SELECT 1 FROM pg_stat_activity WHERE {waits}")))
                primary.sql(f"SELECT pg_cancel_backend(pid) FROM pg_stat_activity WHERE {waits}")
                assert waiting.result(20.0).reason == Refusal.STORE
                assert database.sql("SELECT count(*) FROM sitegrid.journal") == [(2,)], "it is on this host alone"
            wait_for(lambda: isinstance(send(store, 6), Ack))
            wait_for(lambda: replica.shows_all_of(primary))
            assert Database(replica, database.name).sql("SELECT count(*) FROM sitegrid.journal") == [(2,)]
            assert same(store.grid, folded_by(store))


@contextmanager
def stopped(cluster: Cluster) -> Iterator[None]:
    pids = processes_of(cluster)
    for pid in pids:
        os.kill(pid, signal.SIGSTOP)
    try:
        yield
    finally:
        for pid in pids:
            os.kill(pid, signal.SIGCONT)


def processes_of(cluster: Cluster) -> list[int]:
    main = (cluster.data / "postmaster.pid").read_text().split()[0]
    return [int(pid) for pid in (main, *Path(f"/proc/{main}/task/{main}/children").read_text().split())]
