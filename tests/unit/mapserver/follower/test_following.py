"""A follower of a real journal equals the server bit for bit, whatever happens to the journal."""

import os
import shutil
import sqlite3
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapserver.change import change_log
from mapserver.follower import follower as edge
from mapserver.follower.follower import Follower
from mapserver.ingest import following as module
from mapserver.ingest.following import Following
from mapserver.ingest.replica import Replica
from mapserver.ingest.writer import Writer
from mapserver.journal import tail
from mapserver.journal.archive import archive
from mapserver.journal.location import JournalLocation
from mapserver.journal.rows import LAST, JournalRows
from mapserver.journal.sqlite.reader import SqliteReader
from mapserver.journal.table_writer import meta_line
from mapserver.past.making import make
from mapserver.past.past import StorePast
from mapserver.trust.decisions import PERSON, TrustDecision
from mapserver.upkeep.refolding import Refolding
from protocol.errors import QueryError, Refusal, StoreError
from protocol.queries.answers import GroundChange, MapVersion
from protocol.units import HOUR_NS
from tests import postgres_server as server
from tests.patience import PATIENCE_S
from tests.unit.mapserver.data import (
    CONFIG,
    NOW_NS,
    SITE,
    incoming,
    now_ns,
    open_writer,
    past_of,
    random_samples,
    refused,
    routed,
    same,
    send,
    store_at,
    wait_for,
)

pytestmark = pytest.mark.slow  # writer, follower and waits in each


@contextmanager
def following(folder: Path, site=SITE, config=CONFIG) -> Iterator[Following]:
    one = Following(JournalLocation(folder), site, config)
    one.start()
    with closing(one):
        yield one


@pytest.mark.parametrize("folder", ["store", "elsewhere"])
def test_a_follower_of_a_journal_in_postgresql_is_told_of_rows(tmp_path, database, folder):
    location = JournalLocation(tmp_path / "store", database.url)
    with closing(Writer(store_at(location))) as writer:
        deliver(writer, 1)
        writer.run(lambda store: store.save_snapshot())
        deliver(writer, 2)
        one = Following(JournalLocation(tmp_path / folder, database.url), SITE, CONFIG)
        one.start()
        with closing(one):
            catches_up(one, writer)
            for seed in (3, 4, 5):
                deliver(writer, seed, machine="b")
                catches_up(one, writer)
            decided = writer.run(lambda store: store.decide(TrustDecision("b", False, PERSON, "drifts", NOW_NS)))
            wait_for(lambda: version(one).fact == decided.number)
            assert one.run(lambda replica: replica.facts.excluded) == {"b"}


def version(one: Following) -> MapVersion | None:
    try:
        return one.run(lambda replica: replica.version)
    except QueryError:
        return None


def catches_up(one: Following, writer: Writer) -> None:
    wait_for(lambda: version(one) == writer.run(lambda store: store.version))
    ours, theirs = one.run(lambda replica: replica.grid), writer.run(lambda store: store.grid)
    assert one.run(lambda replica: writer.run(lambda store: same(replica.grid, store.grid)))
    assert ours is not theirs
    assert one.run(lambda replica: replica.newest_ns) == writer.run(lambda store: store.newest_ns)
    assert set(one.run(lambda replica: replica.machines())) == set(writer.run(lambda store: store.machines()))


def deliver(writer: Writer, seed: int, n: int = 40, machine: str = "a", first_seq: int = 1) -> None:
    send(writer, [incoming(random_samples(n, seed), first_seq, machine, spool_id=1 + seed)])


def test_a_follower_that_is_started_before_the_server_waits_for_it(tmp_path):
    with following(tmp_path / "store") as one:
        with refused(Refusal.NOT_HERE):
            one.run(lambda replica: replica.version)
        assert one.behind() == (0, float("inf"))
        with closing(open_writer(tmp_path / "store")) as writer:
            deliver(writer, 1)
            catches_up(one, writer)


def test_a_decision_that_is_taken_back_during_the_fold_never_counts_again(tmp_path, monkeypatch):
    may_go_on, folds, fold_anew = threading.Event(), list[int](), module.fold_anew
    adopted, adopt = list[int](), Replica.adopt

    def noted(replica, grid, merged, facts):
        adopted.append(facts.number)
        adopt(replica, grid, merged, facts)

    def held(past, reader, facts, stopped):
        folds.append(facts.number)
        if facts.number == 1:
            assert may_go_on.wait(PATIENCE_S)
        return fold_anew(past, reader, facts, stopped)

    with closing(open_writer(tmp_path)) as writer, following(tmp_path) as one:
        deliver(writer, 1, machine="b")
        catches_up(one, writer)
        monkeypatch.setattr(module, "fold_anew", held)
        monkeypatch.setattr(Replica, "adopt", noted)
        for trusted in (False, True):
            writer.run(lambda store, t=trusted: store.decide(TrustDecision("b", t, PERSON, "drawn", NOW_NS)))
            wait_for(lambda n=1 + trusted: one._replica.tail.event == n)
            wait_for(lambda: folds == [1])
        assert version(one).fact == 2  # the map has the decisions' net effect
        may_go_on.set()
        wait_for(lambda: one._anew is None)
        deliver(writer, 2)
        catches_up(one, writer)
        assert adopted == []


def archive_all(folder: Path, writer: Writer) -> list[Path]:
    location = JournalLocation(folder)

    def forget(until: int) -> int:
        return writer.run(lambda store: store.journal.forget(until))

    with location.reader() as reader:
        return list(archive(location.archive.folder, reader, SITE, NOW_NS + 10**15, forget, NOW_NS))


class Served:
    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._open()

    def _open(self) -> None:
        self.writer = open_writer(self._folder)
        self._refolding = Refolding(self.writer, past_of(self.writer))

    def does(self, what: str, machine: str, number: int, n: int) -> None:
        deliver(self.writer, number, n, machine)
        if what == "decides":
            trusted = self.writer.run(lambda store: machine in store.facts.excluded)
            decision = TrustDecision(machine, trusted, PERSON, "drawn", NOW_NS)
            self._refolding.wait(self._refolding.decide(decision), PATIENCE_S)
        elif what == "archives":
            archive_all(self._folder, self.writer)
        elif what == "starts again":
            self.close()
            self._open()

    def close(self) -> None:
        self._refolding.close()
        self.writer.close()


WHAT = st.sampled_from(["nothing more", "decides", "archives", "starts again"])


@settings(max_examples=6, deadline=None)
@given(
    st.lists(st.tuples(WHAT, st.sampled_from("abc"), st.integers(1, 60)), min_size=1, max_size=12), st.integers(0, 12)
)
def test_any_course_of_rows_decisions_and_starts_makes_the_same_map(tmp_path_factory, course, begins):
    folder = tmp_path_factory.mktemp("store")
    with closing(Served(folder)) as served, closing(Following(JournalLocation(folder), SITE, CONFIG)) as one:
        for number, (what, machine, n) in enumerate(course):
            if number == min(begins, len(course) - 1):
                one.start()
            served.does(what, machine, number, n)
        catches_up(one, served.writer)
        rows, seconds = one.behind()
        assert (rows, 0 <= seconds < PATIENCE_S) == (0, True)


@dataclass(frozen=True)
class Course:
    """Events after each of two machines' first row: other rows, a decision about a machine."""

    seeds: tuple[int, ...] = ()
    decides: str = ""
    archives: bool = False

    def goes_on(self, folder: Path) -> MapVersion:
        with closing(open_writer(folder)) as writer:
            for seed in self.seeds:
                deliver(writer, seed, machine="ab"[seed % 2])
            for name in self.decides:
                writer.run(lambda store, name=name: store.decide(TrustDecision(name, False, PERSON, "drifts", NOW_NS)))
            if self.archives:  # none left in the journal, numbers equal
                assert archive_all(folder, writer)
            return writer.run(lambda store: store.version)


COURSES = {
    "a backup with fewer rows": (Course((2, 3)), Course()),
    "other rows, and more of them": (Course((2, 3)), Course((4, 5, 6))),
    "other rows under archived numbers": (Course((2,), archives=True), Course((3,), archives=True)),
    "another decision under the same number": (Course(decides="a"), Course(decides="b")),
}


@pytest.mark.parametrize("courses", COURSES)
def test_a_journal_that_went_another_course_is_noticed_and_folded_again(tmp_path, caplog, courses):
    mine, theirs = COURSES[courses]
    Course((0, 1)).goes_on(tmp_path / "one")
    shutil.copytree(tmp_path / "one", tmp_path / "other")
    row = mine.goes_on(tmp_path / "one").row
    theirs.goes_on(tmp_path / "other")
    with following(tmp_path / "one") as one:
        wait_for(lambda: (version(one) or MapVersion("", 0, 0)).row == row)
        (tmp_path / "one").rename(tmp_path / "gone")
        (tmp_path / "other").rename(tmp_path / "one")
        wait_for(lambda: "rows are gone" in caplog.text)
        with closing(open_writer(tmp_path / "one")) as writer:
            catches_up(one, writer)
            excluded = writer.run(lambda store: store.facts.excluded)
            assert one.run(lambda replica: replica.facts.excluded) == excluded == set(theirs.decides)
            deliver(writer, 7)
            catches_up(one, writer)
        assert caplog.text.count("rows are gone") == 1


def test_an_epoch_that_is_lower_than_before_is_noticed(tmp_path, caplog):
    with closing(open_writer(tmp_path)) as writer:
        deliver(writer, 1)
    open_writer(tmp_path).close()
    with following(tmp_path) as one:
        wait_for(lambda: version(one) is not None)
        with closing(sqlite3.connect(tmp_path / "journal.db", isolation_level=None)) as db:
            db.execute("REPLACE INTO meta VALUES (?, ?, ?)", meta_line("epoch", "1"))
        wait_for(lambda: "rows are gone" in caplog.text)
        wait_for(lambda: version(one) is not None)
        assert caplog.text.count("rows are gone") == 1


@pytest.mark.parametrize(
    ("site", "problem"), [(replace(SITE, name="quarry"), "quarry"), (replace(SITE, origin_lat_deg=49.0), "frame")]
)
def test_a_journal_of_another_site_or_frame_ends_it(tmp_path, site, problem):
    open_writer(tmp_path).close()
    with following(tmp_path, site) as one:
        wait_for(lambda: one.ended)
        assert problem in one.ended
        assert "compare the site files" in one.ended


DAMAGES = {
    "cut off": lambda path: os.truncate(path, path.stat().st_size // 2),
    "overwritten": lambda path: path.write_bytes(b"garbage" * 20_000),
    "empty": lambda path: path.write_bytes(b""),
    "gone": lambda path: path.unlink(),
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
def test_a_journal_damaged_beneath_a_follower_takes_no_map_away_and_gives_none_to_a_new_one(
    tmp_path, monkeypatch, caplog, damage
):
    monkeypatch.setattr(module, "OPEN_S", 0.2)
    monkeypatch.setattr(module, "MOST_PAUSE_S", 0.1)
    path = tmp_path / "journal.db"
    with closing(open_writer(tmp_path)) as writer:
        for seed in (1, 2, 3):
            deliver(writer, seed)
    with following(tmp_path) as one:
        wait_for(lambda: version(one) is not None)
        sound = path.read_bytes()
        damage(path)
        wait_for(lambda: "cannot follow problem=" in caplog.text and one.behind()[1] > 0.5)
        assert version(one).row == 3
        for snapshot in tmp_path.glob("snapshot-*"):
            snapshot.unlink()
        with following(tmp_path) as new:
            wait_for(lambda: new._problem)
            assert version(new) is None
            assert new.behind()[1] == float("inf")
        path.write_bytes(sound)
        with closing(open_writer(tmp_path)) as writer:
            deliver(writer, 4)
            catches_up(one, writer)


def test_changes_of_the_ground_come_with_the_events(tmp_path):
    change = GroundChange(1, 1, 2, (0.0, 0.0, 1.0, 1.0), 4, None, 0.25, None, 0.5)
    with closing(open_writer(tmp_path)) as writer, following(tmp_path) as one:
        for cells in (4, 9):
            grown = replace(change, cells=cells)
            writer.run(lambda store, g=grown: store.journal.append_event(change_log.KIND, 2, asdict(g)))
        wait_for(lambda: version(one) and one.run(lambda replica: replica.changes) == {1: replace(change, cells=9)})


def test_a_fold_beside_that_fails_is_done_again(tmp_path, monkeypatch):
    fold_anew, folds = module.fold_anew, list[int]()

    def failing(past, reader, facts, stopped):
        folds.append(facts.number)
        if len(folds) == 1:
            raise StoreError("the database", "terminating connection due to administrator command")
        return fold_anew(past, reader, facts, stopped)

    with closing(open_writer(tmp_path)) as writer, following(tmp_path) as one:
        for seed in (1, 2):
            deliver(writer, seed, machine="ab"[seed % 2])
        catches_up(one, writer)
        monkeypatch.setattr(module, "fold_anew", failing)
        writer.run(lambda store: store.decide(TrustDecision("b", False, PERSON, "drifts", NOW_NS)))
        wait_for(lambda: one.run(lambda replica: replica.facts.excluded) == {"b"})
        assert folds == [1, 1]


@pytest.mark.parametrize("error", [StoreError("the journal", "cannot be read"), OSError(5, "Input/output error")])
def test_rows_that_cannot_be_read_for_a_while_are_in_the_map_once(tmp_path, monkeypatch, error):
    read, failures = tail.read_history, iter(range(4))

    def failing(*words):
        rows = [JournalRows.joined([row]) for rows in read(*words) for row in rows]
        yield rows.pop(0)
        if rows and next(failures, None) is not None:
            raise error
        yield from rows

    monkeypatch.setattr(tail, "read_history", failing)
    with closing(open_writer(tmp_path)) as writer:
        for seed in range(4):
            deliver(writer, seed)
        with following(tmp_path) as one:
            catches_up(one, writer)
            with one._lock:  # all visible at once
                for seed in range(4, 8):
                    deliver(writer, seed, machine="b")
            catches_up(one, writer)
    assert next(failures, None) is None


def test_checkpoints_of_rows_that_a_restored_database_has_not_are_not_used(tmp_path, database):
    location = JournalLocation(tmp_path / "store", database.url)
    with closing(store_at(location)) as store:
        for seed in (1, 2, 3):
            store.commit([incoming(random_samples(40, seed), 1, spool_id=seed)])
        with location.reader() as reader:
            past = StorePast.of_store(location.folder, SITE.cell_m, CONFIG.fold)
            assert list(make(past, reader, (NOW_NS // HOUR_NS + 1) * HOUR_NS, store.facts))
    database.sql("DELETE FROM sitegrid.journal WHERE row > 1; DELETE FROM sitegrid.extent WHERE row > 1")
    database.sql(
        "UPDATE sitegrid.head SET last_row = 1; DELETE FROM sitegrid.watermark WHERE spool_id <> '\\x0000000000000001'"
    )
    with closing(store_at(JournalLocation(tmp_path / "other", database.url))) as other:
        for seed in (4, 5, 6):  # another host's server continues
            other.commit([incoming(random_samples(40, seed), 1, spool_id=seed)])
        one = Following(location, SITE, CONFIG)
        one.start()
        with closing(one):
            wait_for(lambda: version(one) == other.version)
            assert one.run(lambda replica: same(replica.grid, other.grid))
            with location.reader() as reader:
                assert same(one.past.grid_as_of(reader, LAST), other.grid)


def test_a_follower_that_cannot_keep_up_is_hidden_until_it_has_caught_up(tmp_path, monkeypatch, caplog):
    may_read, read = threading.Event(), tail.read_history

    def slowly(*words):
        for rows in read(*words):
            assert may_read.wait(PATIENCE_S)
            yield rows

    monkeypatch.setattr(edge, "SHOWN_S", 1.5)  # for ten seconds
    monkeypatch.setattr(tail, "read_history", slowly)
    may_read.set()
    with routed() as (_, session), closing(open_writer(tmp_path)) as writer:
        send(writer, [incoming(random_samples(20, 1), 1, "a")])
        with closing(Follower(session, "slow", JournalLocation(tmp_path), SITE, CONFIG, now_ns)) as one:

            def is_shown() -> bool:
                one.tend()
                return one.is_shown

            wait_for(is_shown)
            may_read.clear()
            send(writer, [incoming(random_samples(20, 2), 21, "a")])
            wait_for(lambda: not is_shown())
            assert "clients ask others" in caplog.text
            assert one.source.origin().behind_rows == 1
            assert writer.run(lambda store: store.merged) == 2, "nobody waits for it"
            may_read.set()
            wait_for(is_shown)
            assert one.source.origin().behind_rows == 0


@pytest.mark.nightly
def test_a_replica_that_is_behind_another_one_has_lost_nothing_and_says_how_old_it_is(tmp_path, caplog):
    with server.cluster() as primary, server.replica(primary, "b") as replica:
        database = primary.new_database()
        with closing(store_at(JournalLocation(tmp_path / "store", database.url))) as store:

            def deliver(seed: int) -> None:
                store.commit([incoming(random_samples(40, seed), 1, spool_id=seed)])

            deliver(1)
            url = replica.url(database.name)
            wait_for(lambda: replica.shows_all_of(primary))
            of_one = Following(JournalLocation(tmp_path / "one", url), SITE, CONFIG)
            ports = f"127.0.0.1:{primary.port},127.0.0.1:{replica.port}"
            pool = f"postgresql://postgres@{ports}/{database.name}?load_balance_hosts=random"
            of_any = Following(JournalLocation(tmp_path / "any", pool), SITE, CONFIG)
            with closing(of_one), closing(of_any):
                for each in (of_one, of_any):
                    each.start()
                    wait_for(lambda each=each: version(each) == store.version and each.behind()[1] < 1)
                replica.sql("SELECT pg_wal_replay_pause()")
                wait_for(lambda: replica.sql("SELECT pg_get_wal_replay_pause_state()") == [("paused",)])
                deliver(2)
                wait_for(lambda: version(of_any) == store.version)
                wait_for(lambda: of_one.behind()[1] > 4)
                assert version(of_one).row == 1
                assert version(of_any) == store.version
                replica.sql("SELECT pg_wal_replay_resume()")
                wait_for(lambda: version(of_one) == store.version and of_one.behind()[1] < 2.5)
        assert "rows are gone" not in caplog.text


def test_without_any_notification_it_looks_again_by_itself(tmp_path, monkeypatch):
    def lost(self, known, timeout_s):  # the notification, not the time-out
        wait_for(lambda: True)
        return self.state()

    monkeypatch.setattr(SqliteReader, "follow", lost)
    with closing(open_writer(tmp_path)) as writer, following(tmp_path) as one:
        deliver(writer, 1)
        catches_up(one, writer)
        deliver(writer, 2)
        catches_up(one, writer)


def test_a_damaged_row_behind_a_sound_one_takes_no_map_away(tmp_path, caplog):
    with closing(open_writer(tmp_path)) as writer, following(tmp_path) as one:
        deliver(writer, 1)
        catches_up(one, writer)

        def damage(store) -> None:
            db = store.journal._db
            record = bytearray(db.execute("SELECT record FROM journal WHERE row = 3").fetchone()[0])
            record[60] ^= 1
            db.execute("UPDATE journal SET record = ? WHERE row = 3", (bytes(record),))

        with one._lock:  # both rows visible at once
            for seed in (2, 3):
                deliver(writer, seed)
            writer.run(damage)
        wait_for(lambda: "journal row 3" in caplog.text)
        wait_for(lambda: one.behind()[1] > 2.5)  # reopened journal
        assert version(one).row == 2
        assert one.behind()[0] == 1
        assert "rows are gone" not in caplog.text
