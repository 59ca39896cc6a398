"""A grid that follows a journal: whatever happens to the journal, it is the fold of the rows that it says it has."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from mapserver.ingest import standby as module
from mapserver.ingest.standby import Standby
from mapserver.ingest.store import Store
from mapserver.journal.journal import JournalQueries
from mapserver.journal.location import JournalLocation
from mapserver.journal.postgres import reader as postgres_reader
from mapserver.trust.decisions import PERSON, TrustDecision
from tests.postgres_server import Database
from tests.unit.mapserver.data import CONFIG, NOW_NS, SITE, fold_of, incoming, now_ns, random_samples, same, wait_for


@pytest.fixture
def location(tmp_path: Path, database: Database) -> JournalLocation:
    return JournalLocation(tmp_path / "one", database.url)


@pytest.fixture
def standby(tmp_path: Path, database: Database, monkeypatch: pytest.MonkeyPatch) -> Iterator[Standby]:
    """One that reads row by row, and tries again at once."""
    for name in ("ROWS_AT_ONCE", "BYTES_AT_ONCE"):
        monkeypatch.setattr(postgres_reader, name, 1)
    monkeypatch.setattr(module, "_MOST_PAUSE_S", 0.0)
    monkeypatch.setattr(module, "_PAUSE_S", 0.0)
    with closing(Standby(JournalLocation(tmp_path / "two", database.url), SITE, CONFIG, bool)) as made:
        yield made


def opened(location: JournalLocation) -> Store:
    return Store(location, SITE, CONFIG, now_ns)


def send(store: Store, first: int, last: int, machine: str = "a") -> None:
    for seq in range(first, last + 1):
        store.commit([incoming(random_samples(1, seq), seq, machine)])


def is_fold(standby: Standby, journal: JournalQueries, without: frozenset[str] = frozenset()) -> bool:
    return same(standby._grid, fold_of(journal.read(until=standby.row), without))


@pytest.mark.parametrize("warm_rows", [0, 2])
def test_before_a_damaged_row_it_waits_and_folds_nothing_twice(location, standby, warm_rows, database):
    with closing(opened(location)) as store:
        send(store, 1, warm_rows)
        if warm_rows:
            standby.follow(5.0)
        send(store, warm_rows + 1, 6)
        ((sound,),) = database.sql("SELECT record FROM sitegrid.journal WHERE row = 4")
        database.sql("UPDATE sitegrid.journal SET record = '\\x00' WHERE row = 4")
        for _ in range(5):
            standby.follow(0.1)
            assert standby.row == 3
            assert is_fold(standby, store.journal)
        assert "journal row 4 is damaged" in standby._problem
        database.sql(f"UPDATE sitegrid.journal SET record = '\\x{sound.hex()}' WHERE row = 4")
        standby.follow(0.1)
        assert (standby.row, standby._problem) == (6, "")
        assert is_fold(standby, store.journal)


def test_rows_of_machines_that_are_left_out_are_passed_once(location, standby):
    with closing(opened(location)) as store:
        send(store, 1, 2)
        standby.follow(5.0)
        row, grid = standby.grid_for(store.journal, store.facts)
        assert (row, same(grid, store.grid)) == (2, True)
        facts = store.decide(TrustDecision("b", False, PERSON, "it lies", NOW_NS))
        assert standby.grid_for(store.journal, facts) is None, "the grid of other facts"
        standby.follow(5.0)
        assert standby.grid_for(store.journal, store.facts) is None
        send(store, 1, 3, machine="b")
        standby.follow(5.0)
        assert standby.row == 5
        assert is_fold(standby, store.journal, facts.excluded)
        send(store, 3, 3)
        standby.follow(5.0)
        assert is_fold(standby, store.journal, facts.excluded)


def restore(database: Database, row: int) -> None:
    """As a backup of the same epoch would have it."""
    database.sql(f"DELETE FROM sitegrid.journal WHERE row > {row}; DELETE FROM sitegrid.extent WHERE row > {row}")
    database.sql(f"UPDATE sitegrid.head SET last_row = {row}")


@pytest.mark.parametrize("rows_since", [0, 2, 4, 6])
def test_a_database_that_is_restored_within_an_epoch_is_folded_again(location, standby, database, rows_since):
    with closing(opened(location)) as store:
        send(store, 1, 4)
        standby.follow(5.0)
        assert standby.has_checked(store.journal)
    restore(database, 1)
    epoch = database.sql("SELECT epoch FROM sitegrid.head")[0][0]
    with closing(opened(location)) as store:
        send(store, 1, rows_since, machine="b")
        database.sql(f"UPDATE sitegrid.head SET epoch = {epoch}")
        assert not standby.has_checked(store.journal)
        assert standby.grid_for(store.journal, store.facts) is None
        standby.follow(5.0)
        assert standby.row == 1 + rows_since
        assert is_fold(standby, store.journal)
        standby.follow(0.1)
        assert standby.has_checked(store.journal)


def test_a_decision_of_another_course_is_not_kept(location, standby, database):
    """A restored database may have another decision under the number of one that is gone."""
    with closing(opened(location)) as store:
        send(store, 1, 4)
        send(store, 1, 4, machine="b")
        store.decide(TrustDecision("b", False, PERSON, "it lies", NOW_NS))
        standby.follow(5.0)
        assert standby._facts.excluded == {"b"}
    restore(database, 2)
    database.sql("DELETE FROM sitegrid.events; UPDATE sitegrid.head SET last_event = 0")
    with closing(opened(location)) as store:
        events = store.journal.state().event
        store.decide(TrustDecision("c", False, PERSON, "it lies", NOW_NS))
        assert events == 1, "what is missing is an event"
    wait_for(lambda: standby.follow(0.1) or standby._facts.excluded == {"c"})
