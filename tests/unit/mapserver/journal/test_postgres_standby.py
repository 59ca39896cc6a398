"""Standby servers of a journal in PostgreSQL and their take-over."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from mapserver.ingest.standby import Standby
from mapserver.ingest.store import Store
from mapserver.journal.journal import FencedError, UnwrittenError
from mapserver.journal.location import JournalLocation
from mapserver.journal.postgres.journal import PostgresJournal
from mapserver.journal.postgres.session import WriterSession
from protocol.errors import Refusal, StoreError
from protocol.wire.messages import Ack, Refused
from tests.postgres_server import Cluster, Database
from tests.unit.mapserver.data import CONFIG, NOW_NS, SITE, now_ns, wait_for
from tests.unit.mapserver.journal.test_postgres import LostAnswer, place, send, synchronous_pair

YEAR_NS = 365 * 86400 * 10**9


def open_store(folder: Path, database: Database, standby: Standby | None = None, clock_ns: int = NOW_NS) -> Store:
    return Store(place(folder, database), SITE, CONFIG, lambda: clock_ns, standby=standby)


class StandsBy:
    """A server waiting on a thread. store: after take-over; error: reason of its end."""

    def __init__(self, folder: Path, database: Database) -> None:
        self.store: Store | None = None
        self.error: BaseException | None = None
        self.on_turn: Callable[[], object] = lambda: None
        self.standby = Standby(place(folder, database), SITE, CONFIG, lambda _: self.on_turn())
        self._words = (folder, database, self.standby)
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            self.store = open_store(*self._words)
        except BaseException as error:
            self.error = error

    def join(self) -> None:
        self._thread.join(20.0)
        assert not self._thread.is_alive()

    def close(self) -> None:
        self.standby.close()
        if self.store:
            self.store.close()


def test_a_session_that_is_lost_while_it_waits_is_closed_and_fences_nobody(tmp_path, database, monkeypatch):
    looked = threading.Semaphore(0)
    real = PostgresJournal._on_loss
    monkeypatch.setattr(PostgresJournal, "_on_loss", lambda self: (real(self), looked.release()))
    first = open_store(tmp_path / "one", database)
    send(first, 1)
    mine = f"application_name = 'sitegrid writer' AND pid <> {first.journal._session._db.info.backend_pid}"
    with closing(StandsBy(tmp_path / "two", database)) as second:
        wait_for(lambda: second.standby.journalled == 1)
        waiting = database.sql(f"SELECT pid FROM pg_stat_activity WHERE {mine}")

        def lose() -> None:
            second.on_turn = lambda: None
            database.sql(f"SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE {mine}")
            assert looked.acquire(timeout=20.0), "it is lost while rows are folded, which takes time"

        second.on_turn = lose
        wait_for(lambda: database.sql(f"SELECT pid FROM pg_stat_activity WHERE {mine}") not in (waiting, []))
        first.close()
        second.join()
        assert second.store.journal.fenced == ""
        assert send(second.store, 6).epoch == 2
        wait_for(lambda: sum(thread.name == "journal" for thread in threading.enumerate()) == 1)


def test_a_standby_whose_take_over_is_cut_waits_again(tmp_path, database, monkeypatch):
    first = open_store(tmp_path / "one", database)
    send(first, 1)
    with closing(StandsBy(tmp_path / "two", database)) as second:
        wait_for(lambda: second.standby.journalled == 1)
        real, cut = WriterSession.run, []

        def run(self: WriterSession, query: Any) -> Any:
            if "SET epoch" in str(query) and not cut:
                cut.append(LostAnswer(self, "SET epoch"))
            return real(self, query)

        monkeypatch.setattr(WriterSession, "run", run)
        first.close()
        second.join()
        assert second.error is None
        assert cut
        assert send(second.store, 6).epoch == 3


def test_a_standby_of_a_database_that_is_made_anew_ends_and_leaves_it_empty(tmp_path, database):
    """Its tables would block the backup's restore."""
    cluster, name = database.cluster, database.name
    with closing(open_store(tmp_path / "one", database)) as store:
        send(store, 1)
    cluster.sql(f"CREATE DATABASE backup_{name} TEMPLATE {name}")
    first = open_store(tmp_path / "one", database)
    with closing(StandsBy(tmp_path / "two", database)) as second:
        wait_for(lambda: second.standby.journalled == 1)
        first.close()
        cluster.sql(f"DROP DATABASE {name} WITH (FORCE)")
        cluster.sql(f"CREATE DATABASE {name}")
        second.join()
        assert second.error or second.store, "it may have been faster than the database was gone"
    for folder in ("one", "two"):  # restarted by supervisors
        with pytest.raises(StoreError, match=r"holds no journal, and .* restore the database from a backup") as caught:
            place(tmp_path / folder, database).prepared_id(SITE.name, SITE.frame)
        assert "\n" not in str(caught.value)
        with pytest.raises(StoreError, match=r"holds no journal, and .* restore the database from a backup"):
            open_store(tmp_path / folder, database)
    assert database.sql("SELECT to_regnamespace('sitegrid')") == [(None,)]
    cluster.sql(f"DROP DATABASE {name} WITH (FORCE)")
    cluster.sql(f"ALTER DATABASE backup_{name} RENAME TO {name}")
    with closing(open_store(tmp_path / "two", database)) as store:
        assert store.journalled == 1


def test_what_a_start_refuses_is_refused_by_a_take_over(tmp_path, database):
    with closing(open_store(tmp_path / "one", database)) as first:
        send(first, 1)
        database.sql("UPDATE sitegrid.extent SET west_m = west_m + 1000")
        second = StandsBy(tmp_path / "two", database)
        wait_for(lambda: second.standby._problem)
    with closing(second):
        second.join()
        assert "the extent of journal row 1 is damaged" in str(second.error)


def test_a_standby_whose_clock_is_a_year_behind_says_so_and_takes_nothing_until_it_is_right(tmp_path, database):
    with closing(open_store(tmp_path / "one", database)) as store:
        send(store, 1)
    with closing(open_store(tmp_path / "two", database, clock_ns=NOW_NS - YEAR_NS)) as other:
        assert send(other, 6).reason == Refusal.SERVER_CLOCK
    with closing(open_store(tmp_path / "two", database, clock_ns=NOW_NS + YEAR_NS)) as other:
        assert (send(other, 6).watermark, other.journal.epoch) == (10, 3), "a year ahead, it takes over"


@pytest.mark.nightly  # make test covers lock, epoch and restores
def test_a_promoted_replica_has_all_that_was_acknowledged_and_the_old_primary_acknowledges_nothing(tmp_path):
    with synchronous_pair() as (primary, replica):
        promotes(tmp_path, primary, replica)


def promotes(tmp_path: Path, primary: Cluster, replica: Cluster) -> None:
    database = primary.new_database()
    both = f"postgresql://postgres@127.0.0.1:{primary.port},127.0.0.1:{replica.port}/{database.name}"
    first = Store(JournalLocation(tmp_path / "one", database.url), SITE, CONFIG, now_ns)
    assert first.info()["replica"] == "synchronous"
    acknowledged = [send(first, k).watermark for k in (1, 6, 11)]
    wait_for(lambda: replica.shows_all_of(primary))
    with JournalLocation(tmp_path / "two", replica.url(database.name)).reader() as follower:
        wait_for(lambda: follower.last_row == 3)
        assert follower.follow(follower.state(), 0.1).row == 3, "a replica has no notifications"

    replica.promote()  # with the old primary alive and written to
    answers: list[Ack | Refused] = []
    writing = threading.Thread(target=lambda: answers.append(send(first, 16)), daemon=True)
    writing.start()
    replica.sql("ALTER SYSTEM RESET synchronous_standby_names")  # alone now, by a person's decision
    replica.sql("SELECT pg_reload_conf()")
    wait_for(lambda: replica.sql("SHOW synchronous_standby_names") == [("",)])
    second = Store(JournalLocation(tmp_path / "two", replica.url(database.name)), SITE, CONFIG, now_ns)
    with closing(second):
        assert second.journal.replica == "none"
        assert [row.first_seq for row in second.journal.read()] == [1, 6, 11]
        assert second.journal.watermark("a", 7).seq == acknowledged[-1]
        answer = send(second, 16)
        assert (answer.watermark, answer.epoch) == (20, 2)
    assert not answers, "the old primary waits for a replica that does not come"
    primary.stop()
    writing.join(20.0)
    assert [type(answer) for answer in answers] == [Refused]
    first.journal._url = both  # both hosts, as configured by an operator
    with pytest.raises((FencedError, UnwrittenError)):
        first.journal.begin()
    first.close()
