from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mapserver.calibration.correction import LAST_NS, NO_SHARE, Correction
from mapserver.calibration.decision import PERSON, SOLVER, CalibrationDecision
from mapserver.ingest import following
from mapserver.ingest.decisions import DECODERS
from mapserver.ingest.standby import Standby
from mapserver.ingest.store import Store
from mapserver.journal.facts import Facts
from mapserver.journal.journal import JournalQueries, UnwrittenError
from mapserver.journal.location import JournalLocation
from mapserver.journal.postgres import reader as postgres_reader
from mapserver.trust.decisions import TrustDecision
from protocol.errors import Refusal, StoreError
from protocol.wire import keys
from protocol.wire.codec import decode_offer
from protocol.wire.messages import Ack, CalibrationOffer, Refused
from sitegrid.security.signing import Signer, Verifier, make_signing_key
from tests.postgres_server import Database
from tests.unit.mapserver.data import (
    CONFIG,
    NOW_NS,
    SITE,
    Incoming,
    fold_of,
    folded,
    incoming,
    now_ns,
    open_store,
    random_samples,
    same,
    samples,
    store_at,
    wait_for,
)


@pytest.fixture
def store(tmp_path):
    opened = open_store(tmp_path)
    yield opened
    opened.close()


def counts(spools: int, samples: int, lost: int, newest_ns: int) -> dict[str, int]:
    return {"spools": spools, "samples": samples, "lost": lost, "newest_ns": newest_ns, "missing": 0}


def test_a_group_is_answered_in_order(store):
    group = [
        incoming(samples(3), 1),
        incoming(samples(2), 9),
        incoming(samples(4), 1, machine="b"),
        Incoming("a", b"rubbish"),
        incoming(samples(5), 2),
        incoming(samples(0), 1),
    ]
    answers = store.commit(group)
    assert answers[0] == Ack(3, 1, store=store.identity.id)
    assert answers[1] == Refused(Refusal.GAP, answers[1].problem, expected=4)
    assert answers[2] == Ack(4, 2, store=store.identity.id)
    assert answers[3].reason == Refusal.NOT_MSGPACK
    assert answers[4] == Ack(6, 3, trimmed=2, store=store.identity.id)
    assert answers[5] == Ack(6, 3, store=store.identity.id)
    assert (store.merged, store.journalled, store.grid.folded) == (3, 3, 10)


def test_a_failed_commit_refuses_all_and_folds_nothing(store, monkeypatch):
    store.commit([incoming(samples(2))])

    def full():
        raise UnwrittenError("journal", "database or disk is full")

    with monkeypatch.context() as patched:
        patched.setattr(store.journal, "commit", full)
        answers = store.commit([incoming(samples(3), 3), incoming(samples(4), machine="b"), Incoming("a", b"?")])
    assert [(a.reason, a.problem) for a in answers] == [
        (Refusal.STORE, "the server cannot write: database or disk is full")
    ] * 3
    assert (store.grid.folded, store.merged, store.journalled) == (2, 1, 1)
    assert store.counters == {"batches": 1, "samples_trimmed": 0, "samples_lost": 0, "refused_store": 3}
    again = store.commit([incoming(samples(3), 3), incoming(samples(4), machine="b")])
    assert [(a.watermark, a.trimmed) for a in again] == [(5, 0), (4, 0)]
    assert store.grid.folded == 9
    assert store.info()["machines"]["b"] == counts(1, 4, 0, NOW_NS + 3 * 10**9)


def test_what_is_refused_or_not_committed_is_neither_journalled_nor_paid_for(store, monkeypatch):
    x_m, y_m = np.random.default_rng(6).uniform(-2e4, 2e4, (2, 400))
    rows = samples(400, x_m=x_m, y_m=y_m, cov_xx_m2=8.9, cov_yy_m2=8.9, stamp_ns=NOW_NS)

    def fails() -> None:
        raise UnwrittenError("journal", "the disk is full")

    with monkeypatch.context() as patched:
        patched.setattr(store.journal, "commit", fails)
        lost = [store.commit([incoming(rows[first : first + 40])])[0] for first in range(50, 400, 40)]
    assert {answer.reason for answer in lost} == {Refusal.STORE}
    (refused,) = store.commit([incoming(rows)])
    assert refused.reason == Refusal.SCATTERED
    assert store.commit([incoming(rows)]) == [refused]
    assert isinstance(store.commit([incoming(rows[:50])])[0], Ack)
    (overlapping,) = store.commit([incoming(rows[:300])])
    assert 50 <= int(overlapping.problem.removeprefix("x_m[").split("]")[0]) < 300, "rows count as they were sent"
    assert (store.journal.samples, store.counters["refused_scattered"]) == (50, 3)


def test_info_tells_the_state_in_plain_values(store):
    far = samples(2, cov_xx_m2=10.0, x_m=900.0, stamp_ns=NOW_NS + 10**12)
    store.commit([incoming(samples(3)), incoming(samples(2), spool_id=8), incoming(far, machine="b")])
    store.grid.known_cells()  # folds waiting samples, which updates cells and bounds
    info = store.info()
    assert (info["samples_merged"], info["samples_too_unsure"], info["cells"]) == (5, 2, 1)
    assert (info["bounds"], info["stamp_ns"]) == ((0, 0, 16, 16), NOW_NS + 10**12)
    assert info["machines"]["a"] == counts(2, 5, 0, NOW_NS + 2 * 10**9)


def test_a_store_that_cannot_be_opened_is_let_go(tmp_path):
    open_store(tmp_path).close()
    for _ in range(2):
        with pytest.raises(StoreError, match="site 'pit'"):
            open_store(tmp_path, site=replace(SITE, name="quarry"))
    open_store(tmp_path).close()


@pytest.mark.parametrize("row", [0, 1])
def test_an_adopted_grid_gets_what_came_since_without_those_excluded(store, row):
    store.commit([incoming(samples(3)), incoming(samples(3), machine="b"), incoming(samples(5), 4)])
    store.adopt(folded(samples(3 * row)), row, Facts(frozenset({"b"})))
    expected = folded(samples(3))
    expected.fold(samples(5), "a")
    assert same(store.grid, expected)
    store.commit([incoming(samples(1), 4, machine="b"), incoming(samples(2), 9)])
    expected.fold(samples(2), "a")
    assert same(store.grid, expected)
    assert (store.merged, store.journalled) == (5, 5)


# Takes batches of 20 samples; hangs in fold number `stuck` with half its pages in the grid.
TAKES = """
import signal
import sys
from pathlib import Path
import numpy as np
from mapserver.evidence import grid
from tests.unit.mapserver.data import incoming, open_store

folder, stuck, saved = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
store = open_store(folder / "store")
fold = grid.fold

def half(rows, *rest):
    if store.merged < stuck:
        yield from fold(rows, *rest)
        return
    pages = list(fold(rows, *rest))
    yield from pages[: len(pages) // 2]
    print("folding", flush=True)
    signal.pause()

grid.fold = half
for i, part in enumerate(np.split(np.load(folder / "rows.npy"), 10)):
    if i == saved:
        store.save_snapshot()
    store.commit([incoming(part, 1 + 20 * i)])
    store.grid.known_cells()  # folds what waits
    print("taken", i + 1, flush=True)
"""


@contextmanager
def taking(folder, stuck: int, saved: int) -> Iterator[subprocess.Popen]:
    """A process taking batches until fold number `stuck`, killed at the end."""
    words = [sys.executable, "-c", f"import sys; sys.path[:0] = {sys.path!r}\n" + TAKES, folder, str(stuck), str(saved)]
    child = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    try:
        yield child
    finally:
        child.kill()
        child.wait()
        child.stdout.close()


@pytest.mark.parametrize(("stuck", "saved"), [(1, 9), (7, 4)])
def test_a_kill_in_the_middle_of_a_fold_leaves_the_same_bits(tmp_path, stuck, saved):
    rows = random_samples(200, 12)
    np.save(tmp_path / "rows.npy", rows)
    with taking(tmp_path, stuck, saved) as child:
        lines = iter(child.stdout.readline, "")
        printed = list(iter(lambda: next(lines), "folding\n"))
        assert printed == [f"taken {i + 1}\n" for i in range(stuck - 1)]
        with pytest.raises(StoreError, match="another server"):
            open_store(tmp_path / "store")
        child.send_signal(signal.SIGKILL)
        assert child.wait(20) == -signal.SIGKILL
    store = open_store(tmp_path / "store")
    assert store.snapshot_row == (saved if saved < stuck else 0)
    assert (store.merged, store.journalled) == (stuck, stuck)  # committed, never acknowledged
    assert same(store.grid, folded(rows[: 20 * stuck]))
    answers = store.commit([incoming(part, 1 + 20 * i) for i, part in enumerate(np.split(rows, 10))])
    assert [answer.trimmed for answer in answers] == [20] * stuck + [0] * (10 - stuck)
    assert same(store.grid, folded(rows))
    store.close()


GONE = "0123456789abcdef"


def test_a_run_that_is_bound_to_another_store_is_refused_until_a_person_accepts_that_one(tmp_path):
    with closing(open_store(tmp_path)) as store:
        bound = incoming(samples(2), 4, lost_before=3, store=GONE)
        refused = store.commit([bound])[0]
        assert refused.reason == Refusal.OTHER_STORE
        assert GONE in refused.problem
        assert store.identity.id in refused.problem
        assert (store.journalled, store.machines()) == (0, {})
        store.accept(GONE, "its disk died")
        store.accept(GONE, "its disk died")  # idempotent
        assert len(store.journal.events("accepted_store")) == 1
    with closing(open_store(tmp_path)) as store:
        assert store.info()["accepted"] == [GONE]
        assert store.commit([bound])[0] == Ack(5, 1, 0, store.identity.id, replaces=GONE)
        assert store.machines()["a"]["lost"] == 3  # samples only in the other store are counted
        assert store.commit([incoming(samples(1), 6, store=store.identity.id)])[0].replaces == ""


DAY = 86_400 * 10**9


def test_the_site_s_now_is_that_of_trusted_machines_and_is_taken_back(tmp_path):
    with closing(open_store(tmp_path)) as store:
        store.commit([incoming(samples(1)), incoming(samples(2, stamp_ns=[NOW_NS + DAY, NOW_NS]), machine="b")])
        assert store.newest_ns == NOW_NS + DAY
        store.decide(TrustDecision("b", trusted=False, by="person", reason="its clock", stamp_ns=1))
        store.adopt(folded(samples(1)), 2, Facts(frozenset({"b"})))
        assert store.newest_ns == store.info()["stamp_ns"] == NOW_NS
        store.commit([incoming(samples(1, stamp_ns=NOW_NS + DAY), 3, machine="b")])
        assert (store.newest_ns, store.machines()["b"]["newest_ns"]) == (NOW_NS, NOW_NS + DAY)
    with closing(open_store(tmp_path)) as store:
        assert store.newest_ns == NOW_NS


def test_a_server_whose_clock_went_back_says_so_until_it_is_right_again(tmp_path):
    clock = [NOW_NS + 400 * DAY]
    with closing(Store(JournalLocation(tmp_path), SITE, CONFIG, lambda: clock[0])) as store:
        assert isinstance(store.commit([incoming(samples(1, stamp_ns=clock[0]))])[0], Ack)
        clock[0] -= 300 * DAY
        monday = incoming(samples(1, stamp_ns=NOW_NS + 403 * DAY), 2)
        assert store.commit([monday])[0].reason == Refusal.SERVER_CLOCK
    # also known from the journal
    with closing(Store(JournalLocation(tmp_path), SITE, CONFIG, lambda: clock[0])) as store:
        assert store.commit([monday])[0].reason == Refusal.SERVER_CLOCK
        clock[0] += 303 * DAY
        assert isinstance(store.commit([monday])[0], Ack)


def test_only_its_owner_reads_the_files_of_a_store(tmp_path):
    before = os.umask(0)
    try:
        store = open_store(tmp_path)
        store.commit([incoming(samples(3))])
        store.save_snapshot()
        modes = {path.name: path.stat().st_mode & 0o777 for path in tmp_path.rglob("*") if path.is_file()}
        store.close()
    finally:
        os.umask(before)
    assert {"journal.db", "journal.db-wal", "journal.db-mark", "lock", "snapshot-1.checkpoint"} <= modes.keys()
    assert set(modes.values()) == {0o600}


def test_a_snapshot_beyond_the_journal_is_named_before_it_is_removed(tmp_path, caplog):
    store = open_store(tmp_path)
    store.commit([incoming(samples(3))])
    store.save_snapshot()
    store.close()
    (tmp_path / "snapshot-1.checkpoint").rename(tmp_path / "snapshot-7.checkpoint")
    store = open_store(tmp_path)
    assert store.info()["shortfalls"] == [
        "a snapshot of row 7 lies beyond the journal; 6 journal rows after row 1 are gone"
    ]
    assert "acknowledged samples are missing" in caplog.text
    assert "snapshot-7.checkpoint row=7 last_row=1" in caplog.text
    assert not (tmp_path / "snapshot-7.checkpoint").exists()
    store.close()
    store = open_store(tmp_path)
    assert len(store.info()["shortfalls"]) == 1, "it is kept, and not said again"
    store.close()


def test_samples_that_are_missing_are_counted_until_they_are_declared_lost(tmp_path, caplog):
    store = open_store(tmp_path)
    store.commit([incoming(samples(3))])
    store.journal._mark.write({f"a {7:016x}": 5, f"b {8:016x}": 2})  # as a longer journal had
    store.close()
    store = open_store(tmp_path)
    assert {name: entry["missing"] for name, entry in store.machines().items()} == {"a": 2, "b": 2}
    assert store.machines()["b"] == {"spools": 0, "samples": 0, "lost": 0, "newest_ns": 0, "missing": 2}
    answers = store.commit([incoming(samples(2), 6)])
    assert (answers[0].reason, answers[0].expected) == ("gap", 4)
    store.commit([incoming(samples(2), 6, lost_before=2)])
    assert store.machines()["a"]["missing"] == 0
    assert store.machines()["a"]["lost"] == 2
    assert "declared lost machine=a samples=2" in caplog.text
    store.close()


COVARIANCE = ((4e-7, 1e-7, 0.0), (1e-7, 2e-5, 0.0), (0.0, 0.0, 1e-6))


def calibrated(machine, *spans, by=SOLVER, stamp_ns=NOW_NS):
    """Decision about a machine: spans of from_ns, to_ns, zero, covariance."""
    corrections = tuple(Correction(machine, start, end, zero, 0.05, 0.0, cov) for start, end, zero, cov in spans)
    return CalibrationDecision(machine, by, "", stamp_ns, corrections)


def offered(store, machine="a"):
    """The offer with the next sample's acknowledgement."""
    seq = store.journal.watermark(machine, 7).seq + 1
    table = store.commit([incoming(samples(1), seq, machine=machine)])[0].offer
    return table and decode_offer(table)


def test_a_machine_is_offered_what_is_taken_off_its_newest_samples(store):
    assert offered(store) is None
    early, late = (0, NOW_NS, 0.001, COVARIANCE), (NOW_NS, LAST_NS, 0.004, COVARIANCE)
    store.decide(calibrated("a", early, late))
    assert offered(store) == CalibrationOffer("a", NOW_NS, 0.004, 0.05, 4e-7, 2e-5, 1e-7)
    assert offered(store, "b") is None
    store.decide(calibrated("a", (0, LAST_NS, 0.02, COVARIANCE), by=PERSON, stamp_ns=NOW_NS + 5))
    assert (offered(store).zero, offered(store).stamp_ns) == (0.02, NOW_NS + 5)


@pytest.mark.parametrize(
    ("end_ns", "covariance", "most_share", "trusted"),
    [
        (NOW_NS, COVARIANCE, 1.0, True),  # ended
        (LAST_NS, (), 1.0, True),  # unknown quality
        (LAST_NS, COVARIANCE, NO_SHARE, True),  # no force sensor
        (LAST_NS, COVARIANCE, 1.0, False),
    ],
)
def test_what_no_machine_may_take_is_not_offered(store, end_ns, covariance, most_share, trusted):
    correction = Correction("a", 0, end_ns, 0.004, 0.05, 0.0, covariance, most_share)
    store.decide(CalibrationDecision("a", SOLVER, "", NOW_NS, (correction,)))
    store.decide(TrustDecision("a", trusted=trusted, by="person", reason="moved", stamp_ns=1))
    assert offered(store) is None


def test_an_acknowledgement_without_new_samples_offers_nothing(store):
    store.decide(calibrated("a", (0, LAST_NS, 0.004, COVARIANCE)))
    batch = incoming(samples(2))
    assert store.commit([batch])[0].offer
    assert store.commit([batch, incoming(samples(0), 3)]) == [
        Ack(2, 1, trimmed=2, store=store.identity.id),
        Ack(2, 1, store=store.identity.id),
    ]


PRIVATE, PUBLIC = make_signing_key()
OTHER, _ = make_signing_key()


@pytest.fixture
def signed_store(tmp_path):
    with closing(Store(JournalLocation(tmp_path), SITE, CONFIG, now_ns, Verifier({"a": PUBLIC}).check)) as opened:
        yield opened


def signed(machine: str = "a", key: bytes = PRIVATE, under: str = "") -> Incoming:
    batch = incoming(samples(3), machine=machine)
    return Incoming(machine, batch.payload, Signer(key).sign(keys.ingest(SITE.name, under or machine), batch.payload))


@pytest.mark.parametrize(
    ("batch", "problem"),
    [
        (incoming(samples(3)), "is not signed"),
        (signed(key=OTHER), "is not that of 'a'"),
        (signed(under="b"), "is not that of 'a'"),
        (Incoming("a", signed().payload + b"x", signed().signature), "is not that of 'a'"),
        (signed(machine="stranger"), "no signing key of 'stranger'"),
        (Incoming("", signed().payload, signed().signature), "names no machine"),
    ],
)
def test_what_a_machine_did_not_sign_for_its_own_key_is_refused_and_leaves_no_trace(signed_store, batch, problem):
    (answer,) = signed_store.commit([batch])
    assert answer.reason == "wrong_machine"
    assert problem in answer.problem
    assert signed_store.counters["refused_wrong_machine"] == 1
    assert (signed_store.journalled, signed_store.grid.state().folded) == (0, 0)
    assert isinstance(signed_store.commit([signed()])[0], Ack)


@pytest.fixture
def location(tmp_path: Path, database: Database) -> JournalLocation:
    return JournalLocation(tmp_path / "one", database.url)


@pytest.fixture
def standby(tmp_path: Path, database: Database, monkeypatch: pytest.MonkeyPatch) -> Iterator[Standby]:
    """A standby reading row by row, retrying at once."""
    for name in ("ROWS_AT_ONCE", "BYTES_AT_ONCE"):
        monkeypatch.setattr(postgres_reader, name, 1)
    monkeypatch.setattr(following, "MOST_PAUSE_S", 0.0)
    monkeypatch.setattr(following, "PAUSE_S", 0.0)
    with closing(Standby(JournalLocation(tmp_path / "two", database.url), SITE, CONFIG, bool)) as made:
        yield made


def send(store: Store, first: int, last: int, machine: str = "a") -> None:
    for seq in range(first, last + 1):
        store.commit([incoming(random_samples(1, seq), seq, machine)])


def is_fold(standby: Standby, journal: JournalQueries, without: frozenset[str] = frozenset()) -> bool:
    replica = standby._replica
    return same(replica.grid, fold_of(journal.read(until=replica.merged), without))


def row_of(standby: Standby) -> int:
    return standby._replica.merged


@pytest.mark.parametrize("warm_rows", [0, 2])
def test_before_a_damaged_row_it_waits_and_folds_nothing_twice(location, standby, warm_rows, database):
    with closing(store_at(location)) as store:
        send(store, 1, warm_rows)
        if warm_rows:
            standby.follow(5.0)
        send(store, warm_rows + 1, 6)
        ((sound,),) = database.sql("SELECT record FROM sitegrid.journal WHERE row = 4")
        database.sql("UPDATE sitegrid.journal SET record = '\\x00' WHERE row = 4")
        for _ in range(5):
            standby.follow(0.1)
            assert row_of(standby) == 3
            assert is_fold(standby, store.journal)
        assert "journal row 4 is damaged" in standby._problem
        database.sql(f"UPDATE sitegrid.journal SET record = '\\x{sound.hex()}' WHERE row = 4")
        standby.follow(0.1)
        assert (row_of(standby), standby._problem) == (6, "")
        assert is_fold(standby, store.journal)


def test_what_is_decided_while_a_row_is_damaged_counts_in_the_rows_before_it(location, standby, database):
    with closing(store_at(location)) as store:
        send(store, 1, 2)
        send(store, 1, 1, machine="b")
        send(store, 3, 4)
        database.sql("UPDATE sitegrid.journal SET record = '\\x00' WHERE row = 4")
        standby.follow(0.1)
        assert is_fold(standby, store.journal)
        facts = store.decide(TrustDecision("b", False, PERSON, "it lies", NOW_NS))
        for _ in range(3):
            standby.follow(0.1)
            assert (row_of(standby), standby._replica.facts, standby._anew) == (3, facts, None)
            assert is_fold(standby, store.journal, facts.excluded)


def test_rows_of_machines_that_are_left_out_are_passed_once(location, standby):
    with closing(store_at(location)) as store:
        send(store, 1, 2)
        standby.follow(5.0)
        row, grid = standby.grid_for(store.journal, store.facts)
        assert (row, same(grid, store.grid)) == (2, True)
        facts = store.decide(TrustDecision("b", False, PERSON, "it lies", NOW_NS))
        assert standby.grid_for(store.journal, facts) is None, "the grid of other facts"
        wait_for(lambda: standby.follow(0.1) or standby.grid_for(store.journal, facts))
        assert standby.grid_for(store.journal, store.facts) is None
        send(store, 1, 3, machine="b")
        standby.follow(5.0)
        assert row_of(standby) == 5
        assert is_fold(standby, store.journal, facts.excluded)
        send(store, 3, 3)
        standby.follow(5.0)
        assert is_fold(standby, store.journal, facts.excluded)


def restore(database: Database, row: int) -> None:
    """From a backup of the same epoch."""
    database.sql(f"DELETE FROM sitegrid.journal WHERE row > {row}; DELETE FROM sitegrid.extent WHERE row > {row}")
    database.sql(f"UPDATE sitegrid.head SET last_row = {row}")


@pytest.mark.parametrize("rows_since", [0, 2, 4, 6])
def test_a_database_that_is_restored_within_an_epoch_is_folded_again(location, standby, database, rows_since):
    with closing(store_at(location)) as store:
        send(store, 1, 4)
        standby.follow(5.0)
        assert standby.has_checked(store.journal)
    restore(database, 1)
    epoch = database.sql("SELECT epoch FROM sitegrid.head")[0][0]
    with closing(store_at(location)) as store:
        send(store, 1, rows_since, machine="b")
        database.sql(f"UPDATE sitegrid.head SET epoch = {epoch}")
        assert not standby.has_checked(store.journal)
        assert standby.grid_for(store.journal, store.facts) is None
        standby.follow(5.0)
        assert row_of(standby) == 1 + rows_since
        assert is_fold(standby, store.journal)
        standby.follow(0.1)
        assert standby.has_checked(store.journal)


def test_a_decision_of_another_course_is_not_kept(location, standby, database):
    """A restored database may reuse a lost decision's number."""
    with closing(store_at(location)) as store:
        send(store, 1, 4)
        send(store, 1, 4, machine="b")
        store.decide(TrustDecision("b", False, PERSON, "it lies", NOW_NS))
        standby.follow(5.0)
        assert standby._replica.facts.excluded == {"b"}
    restore(database, 2)
    database.sql("DELETE FROM sitegrid.events; UPDATE sitegrid.head SET last_event = 0")
    with closing(store_at(location)) as store:
        events = store.journal.state().event
        store.decide(TrustDecision("c", False, PERSON, "it lies", NOW_NS))
        assert events == 1, "what is missing is an event"
    wait_for(lambda: standby.follow(0.1) or standby._replica.facts.excluded == {"c"})


@pytest.mark.parametrize("kind", DECODERS)
def test_a_decision_of_another_program_is_named(tmp_path, kind):
    with closing(open_store(tmp_path)) as store:
        store.journal.append_event(kind, 1, {"another": "form"})
    with pytest.raises(StoreError, match=r"journal.db: event 1 is of another program \("):
        open_store(tmp_path)
