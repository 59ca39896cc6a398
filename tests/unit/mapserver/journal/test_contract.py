"""The contract of all journals, for every database."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from mapserver.ingest.store import Store
from mapserver.journal.history import history_rows
from mapserver.journal.journal import ArchivedError, Journal, JournalReader, JournalState, UnwrittenError
from mapserver.journal.location import JournalLocation
from mapserver.journal.postgres.journal import PostgresJournal
from mapserver.journal.rows import ALL, Admission, Selection, Watermark
from mapserver.journal.sqlite.journal import SqliteJournal
from protocol.errors import StoreError
from protocol.site.geometry import Bounds
from protocol.version import package_version
from protocol.wire.fields import pack, unpack
from protocol.wire.messages import Ack, Refused
from tests.postgres_server import Database
from tests.unit.mapserver.data import NOW_NS, SITE, batch, fold_of, incoming, random_samples, same, samples, store_at


@dataclass
class Place:
    """sql: run a statement on another connection."""

    location: JournalLocation
    sql: Callable[[str], Any]

    def open(self, site: str = SITE.name, frame: str = SITE.frame) -> Journal:
        return self.location.open(site, frame)

    def store(self) -> Store:
        return store_at(self.location)


@pytest.fixture(params=["sqlite", "postgres"])
def place(request: pytest.FixtureRequest, tmp_path: Path) -> Place:
    if request.param == "sqlite":
        import sqlite3

        def sql(statement: str) -> Any:
            with closing(sqlite3.connect(tmp_path / "journal.db", isolation_level=None)) as db:
                return db.execute(statement).fetchall()

        return Place(JournalLocation(tmp_path), sql)
    database: Database = request.getfixturevalue("database")

    def run(statement: str) -> Any:
        return database.sql(f"SET search_path = sitegrid; {statement}")

    return Place(JournalLocation(tmp_path, database.url), run)


@pytest.fixture
def journal(place: Place) -> Iterator[Journal]:
    with closing(place.open()) as opened:
        yield opened


@pytest.fixture
def reader(place: Place, journal: Journal) -> Iterator[JournalReader]:
    with place.location.reader() as opened:
        yield opened


def admission(n: int = 3, first_seq: int = 1, lost: int = 0, **more: Any) -> Admission:
    return Admission(batch(random_samples(n, first_seq), first_seq, **more), trimmed=0, lost=lost)


def write(journal: Journal, *admissions: Admission) -> None:
    journal.begin()
    for one in admissions:
        journal.append(one, NOW_NS)
    journal.commit()


def test_rows_read_back_bit_for_bit_by_writer_and_reader(journal, reader):
    sent = [admission(4, machine="it's a machine"), admission(300, spool_id=2**64 - 1), admission(1, 5, lost=2)]
    sent += [admission(i, spool_id=spool) for i, spool in enumerate((1, 2**63 - 1, 2**63, 2**63 + 1), start=1)]
    write(journal, *sent)
    for queries in (journal, reader):
        rows = list(queries.read())
        assert [row.row for row in rows] == [1, 2, 3, 4, 5, 6, 7]
        assert [row.rows.tobytes() for row in rows] == [one.batch.rows.tobytes() for one in sent]
        assert [(row.machine, row.spool_id, row.first_seq, row.received_ns) for row in rows] == [
            (one.batch.machine, one.batch.spool_id, one.batch.first_seq, NOW_NS) for one in sent
        ]
        reached = {key: mark.seq for key, mark in queries.watermarks().items()}
        assert reached == {(one.batch.machine, one.batch.spool_id): one.watermark for one in sent}
        queries.check()
    assert journal.watermark("a", 7) == Watermark(5, 2, int(sent[2].batch.rows["stamp_ns"].max()))
    assert journal.samples == 4 + 300 + (5 - 2) + 1 + 2 + 3 + 4
    assert reader.identity() == journal.identity()


def test_every_writer_has_a_higher_epoch(place):
    epochs = []
    for _ in range(3):
        with closing(place.open()) as journal:
            epochs.append(journal.epoch)
            assert journal.state().epoch == journal.epoch
    assert epochs == sorted(set(epochs))


def test_nothing_of_an_open_transaction_is_read_or_stays(place, journal, reader):
    write(journal, admission())
    journal.begin()
    journal.append(admission(2, 4), NOW_NS)
    journal.append(admission(2, machine="new"), NOW_NS)
    assert (journal.last_row, reader.last_row) == (3, 1)
    journal.rollback()
    assert (journal.last_row, journal.watermark("a", 7).seq) == (1, 3)
    assert set(journal.machines()) == {"a"}
    write(journal, admission(1, 4))
    assert [row.first_seq for row in reader.read()] == [1, 4]
    assert journal.machines()["a"].samples == 4


def test_lost_samples_are_summed_and_move_the_watermark_alone(journal, reader):
    write(journal, admission(), admission(2, 6, lost=2), admission(1, 9, lost=1))
    journal.begin()
    journal.declare_lost(Admission(batch(samples(0), 16), trimmed=0, lost=6))
    journal.commit()
    assert (reader.watermarks()["a", 7].seq, reader.watermarks()["a", 7].lost) == (15, 2 + 1 + 6)
    assert reader.last_row == 3


def test_events_are_numbered_and_all_or_none(journal, reader):
    assert journal.append_events([]) == 0
    assert journal.append_event("t", 5, {"quote": "it's"}) == 1
    assert journal.append_events([("u", 6, {}), ("t", 7, {"n": [1, None]})]) == 3
    with pytest.raises(ValueError, match="JSON"):
        journal.append_events([("t", 8, {}), ("t", 9, {"n": float("nan")})])
    assert [(e.id, e.kind, e.stamp_ns, e.body) for e in reader.events("t")] == [
        (1, "t", 5, {"quote": "it's"}),
        (3, "t", 7, {"n": [1, None]}),
    ]
    assert [e.id for e in reader.events(after=1)] == [2, 3]
    assert reader.state().event == 3


def test_rows_are_selected_by_time_and_place(journal, reader):
    for k in range(5):
        rows = samples(2, stamp_ns=NOW_NS + k * 100, x_m=float(10 * k))
        write(journal, Admission(batch(rows, 1 + 2 * k), trimmed=0, lost=0))
    assert [r.row for r in reader.read(selection=Selection(from_ns=NOW_NS + 100, to_ns=NOW_NS + 200))] == [2, 3]
    box = Bounds(25.0, 0.0, 45.0, 20.0)
    assert [r.row for r in reader.read(selection=Selection(bounds=box))] == [4, 5]
    assert [r.row for r in reader.read(after=1, until=4)] == [2, 3, 4]
    chunks = [(NOW_NS, NOW_NS + 100), (NOW_NS + 200, NOW_NS + 300), (NOW_NS + 400, NOW_NS + 400)]
    assert reader.stamps_by_chunk(0, 5, 2) == [(number, *stamps) for number, stamps in enumerate(chunks)]
    assert reader.least_stamp(0, 5, NOW_NS + 150) == NOW_NS + 200
    assert reader.least_stamp(0, 5, NOW_NS + 401) is None
    assert reader.rows_before(0, 5, NOW_NS + 200) == 2


def test_archived_rows_are_forgotten_in_pieces(journal, reader):
    write(journal, *(admission(1, k) for k in range(1, 8)))
    assert journal.forget(3, most=2) == 2
    assert journal.forget(3) == 3
    assert journal.forget(2) == 3
    assert (reader.archived_row, reader.last_row) == (3, 7)
    for after, selection in ((0, ALL), (2, ALL), (0, Selection(from_ns=NOW_NS + 10**15))):
        with pytest.raises(ArchivedError, match="rows up to 3 are in the archive") as caught:
            list(reader.read(after, selection=selection))
        assert caught.value.archived_row == 3
    assert list(reader.read(after=2, until=2)) == []
    assert [row.row for row in reader.read(3)] == [4, 5, 6, 7]
    assert reader.row_checksum(3) is None
    reader.check()
    journal.shrink()


def test_the_checksum_of_a_row_or_an_event_tells_it_from_another(place, journal, reader):
    write(journal, admission(), admission(2, 4))
    first, second = reader.row_checksum(1), reader.row_checksum(2)
    assert first != second
    assert journal.row_checksum(2) == second
    assert reader.row_checksum(3) is None
    journal.append_events([("t", 1, {}), ("t", 1, {"x": 0.1})])
    assert [reader.event_checksum(number) for number in (0, 1, 2)] == [None, *(e.checksum for e in reader.events())]
    assert reader.event_checksum(1) != reader.event_checksum(2)


def test_a_follower_waits_for_news(journal, reader):
    known = reader.state()
    assert reader.follow(known, 0.05) == known
    seen: list[JournalState] = []
    waiting = threading.Thread(target=lambda: seen.append(reader.follow(known, 20.0)))
    waiting.start()
    write(journal, admission())
    waiting.join(20.0)
    assert [(state.row, state.event) for state in seen] == [(1, 0)]
    journal.append_event("t", 1, {})
    assert reader.follow(seen[0], 20.0).event == 1


def test_a_journal_of_another_site_or_frame_is_refused(place):
    place.open().close()
    for words, named in ((("hill", SITE.frame), "site"), ((SITE.name, "0"), "frame")):
        with pytest.raises(StoreError, match=rf"{named}.*choose another --store"):
            place.open(*words)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ("UPDATE watermark SET seq = seq + 1", "watermark of a"),
        ("UPDATE extent SET west_m = west_m - 1 WHERE row = 2", "extent of journal row 2"),
        ("DELETE FROM extent WHERE row = 2", "what follows number 1"),
        ("UPDATE events SET stamp_ns = 0", "event 1"),
        ("UPDATE meta SET value = 'x' WHERE key = 'store'", "the store of the journal"),
        ("UPDATE meta SET value = 'hill' WHERE key = 'site'", "the site of the journal"),
        ("DELETE FROM events WHERE id = 2", "what follows number 1"),
        ("DELETE FROM events WHERE id = 1", "what follows number 0"),
        ("UPDATE events SET kind = 'u' WHERE id = 2", "event 2"),
        ("DELETE FROM extent WHERE row = 3", "what follows number 2"),
        ("UPDATE extent SET row = 9 WHERE row = 3", "the extent of journal row 9"),
        ("DELETE FROM meta WHERE key = 'frame'", "the frame of the journal"),
    ],
)
def test_damage_is_found_on_opening(place, monkeypatch, change, problem):
    monkeypatch.setattr("mapserver.journal.table_queries._EXTENTS_AT_ONCE", 2)  # read in two pieces
    with closing(place.open()) as journal:
        write(journal, admission(), admission(1, 4), admission(1, 5))
        for stamp_ns in (5, 6):
            journal.append_event("t", stamp_ns, {})
    place.sql(change)
    with pytest.raises(StoreError, match=problem):
        place.open().close()


def test_samples_at_minus_zero_are_no_damage(place):
    """Databases turn -0.0 into 0.0, of other bits."""
    rows = samples(3, x_m=[-0.0, -0.0, 5.0], y_m=[-7.0, -0.0, -0.0])
    with closing(place.open()) as journal:
        write(journal, Admission(batch(rows), trimmed=0, lost=0), Admission(batch(rows[1:2], 4), trimmed=0, lost=0))
    with closing(place.open()) as journal:
        assert [row.rows.tobytes() for row in journal.read()] == [rows.tobytes(), rows[1:2].tobytes()]
        assert [row.row for row in journal.read(selection=Selection(bounds=Bounds(-1.0, -1.0, 0.0, 0.0)))] == [1, 2]


def test_losses_beyond_what_the_wire_has_can_be_asked_for(place):
    """One machine's declared loss must not block reading the others' state."""
    most = 2**62
    with closing(place.store()) as store:
        for spool_id in range(1, 7):
            lost = incoming(samples(1), most, spool_id=spool_id, lost_before=most - 1)
            assert isinstance(store.commit([lost])[0], Ack)
    with closing(place.store()) as store:
        assert unpack(pack(store.info()), 2**16)["machines"]["a"]["lost"] == 2**64 - 1
        assert store.machines()["a"]["samples"] == 6


def test_another_schema_is_refused(place):
    place.open().close()
    place.sql("UPDATE meta SET value = '99' WHERE key = 'schema'")
    version = package_version()
    for statement, writer in ((None, f"sitegrid {version}"), ("DELETE FROM meta WHERE key = 'version'", "the version")):
        if statement:
            place.sql(statement)
        for opened in (place.open, place.location.reader):
            with pytest.raises(StoreError, match=rf"schema '99', this version knows \d+; open it with {writer} that"):
                opened()


class Faults:
    """Fails the n-th statement of a journal, before it runs or after it, as with a lost answer."""

    def __init__(self, number: int, mode: str) -> None:
        self.left, self.mode, self.happened = number, mode, False

    def into(self, journal: Any) -> None:
        if isinstance(journal, PostgresJournal):
            self._wrap(journal._session, "run", journal)
        else:
            assert isinstance(journal, SqliteJournal)
            self._wrap(journal, "_write", journal)

    def _wrap(self, target: Any, name: str, journal: Any) -> None:
        real = getattr(target, name)

        def faulty(*words: Any) -> Any:
            self.left -= 1
            if self.left != 0:
                return real(*words)
            self.happened = True
            if self.mode == "answer lost":
                real(*words)
            if self.mode != "full" and isinstance(journal, PostgresJournal):
                with journal._session._turn:  # its own thread may be asking
                    journal._session._lose("the connection was cut")
            raise UnwrittenError(journal.where, "the disk is full")

        setattr(target, name, faulty)


FAULTS = [("sqlite", number, "full") for number in range(1, 10)]
FAULTS += [("postgres", number, mode) for number in range(1, 5) for mode in ("full", "cut", "answer lost")]


@pytest.mark.parametrize(("place", "number", "mode"), FAULTS, indirect=["place"])
def test_after_a_fault_at_any_statement_nothing_is_lost_or_double(place, number, mode):
    faults = Faults(number, mode)
    sent = {machine: random_samples(20, seed) for seed, machine in enumerate("ab")}
    with closing(place.store()) as store:
        faults.into(store.journal)
        reached, acknowledged = dict.fromkeys(sent, 0), []
        for _ in range(40):
            if all(seq == 20 for seq in reached.values()):
                break
            group = [(machine, seq + 1, min(20, seq + 5)) for machine, seq in reached.items() if seq < 20]
            answers = store.commit([incoming(sent[m][first - 1 : last], first, m) for m, first, last in group])
            for (machine, _, _), answer in zip(group, answers, strict=True):
                assert isinstance(answer, Ack | Refused)
                if isinstance(answer, Ack):
                    assert answer.epoch == store.journal.epoch
                    acknowledged.append((machine, answer.watermark))
                    reached[machine] = answer.watermark
        assert faults.happened
        assert set(reached.values()) == {20}
        assert_whole(store, sent)
    with closing(place.store()) as again:
        assert not again.shortfalls
        assert_whole(again, sent)
        assert all(again.journal.watermark(machine, 7).seq >= seq for machine, seq in acknowledged)


def assert_whole(store: Store, sent: dict[str, Any]) -> None:
    """Each sample is in the journal once, bit for bit, and the grid is their fold."""
    there: dict[str, list[bytes]] = {machine: [] for machine in sent}
    for row in history_rows(store.history):
        there[row.machine] += [sample.tobytes() for sample in row.rows]
    assert there == {machine: [sample.tobytes() for sample in rows] for machine, rows in sent.items()}
    assert same(store.grid, fold_of(history_rows(store.history)))
    assert store.merged == store.journalled == store.journal.state().row
