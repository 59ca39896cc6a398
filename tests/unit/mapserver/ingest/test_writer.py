import sqlite3
import threading
from concurrent.futures import Future
from dataclasses import replace
from typing import Any

import msgpack
import numpy as np
import pytest

from mapserver.config import ServerConfig, StoreConfig
from mapserver.evidence import snapshot
from mapserver.ingest import writer as writer_module
from mapserver.ingest.store import Store
from mapserver.ingest.writer import GROUP_BATCHES, QUEUE_BATCHES, Writer
from mapserver.journal.journal import Journal
from mapserver.query.answering import Answers
from protocol.errors import QueryError, Refusal
from protocol.wire.codec import MAX_BATCH_BYTES, encode_batch
from protocol.wire.messages import Ack
from tests.unit.mapserver.data import (
    CONFIG,
    NOW_NS,
    SITE,
    WAIT_S,
    Incoming,
    Replies,
    batch,
    folded,
    held,
    incoming,
    open_writer,
    random_samples,
    same,
    samples,
    send,
    wait_for,
)
from tests.unit.mapserver.query.fake_follower import FakeFollower, answered


@pytest.fixture
def start(tmp_path, monkeypatch):
    writers = []

    def start_writer(site=SITE, snapshot_rows: int = 2000, **options: Any) -> Writer:
        monkeypatch.setattr(writer_module, "SNAPSHOT_ROWS", snapshot_rows)
        writers.append(open_writer(tmp_path, ServerConfig(store=StoreConfig(**options)), site))
        return writers[-1]

    yield start_writer
    for writer in writers:
        writer.close()


def spied(monkeypatch, method: str) -> list[str]:
    """Record the calls of a method of Journal; a test may add what else happens."""
    events: list[str] = []
    real = getattr(Journal, method)

    def spy(self, *args):
        result = real(self, *args)
        events.append(method)
        return result

    monkeypatch.setattr(Journal, method, spy)
    return events


# --- batches ---------------------------------------------------------------------------------------------------------


def test_batches_are_acknowledged_in_order_and_merged(start):
    writer = start()
    parts = np.split(random_samples(200, 9), 20)
    answers = send(writer, [incoming(part, 1 + 10 * i) for i, part in enumerate(parts)])
    assert answers == [Ack(10 * (i + 1), i + 1, store=writer.store_id) for i in range(20)]
    assert same(writer.run(lambda store: store.grid), folded(np.concatenate(parts)))


def test_acknowledged_only_after_the_commit(start, monkeypatch):
    events = spied(monkeypatch, "commit")
    writer = start()
    done = threading.Event()
    with held(writer):
        for i in range(3):
            writer.submit(incoming(samples(2), 1 + 2 * i), lambda _: events.append("ack"))
        assert events == []
    writer.submit(incoming(samples(2), 7), lambda _: (events.append("ack"), done.set()))
    assert done.wait(WAIT_S)
    assert events[:4] == ["commit", "ack", "ack", "ack"]
    assert events.count("commit") <= 2


@pytest.mark.parametrize(("waiting", "commits"), [(6, 1), (GROUP_BATCHES, 1), (GROUP_BATCHES + 1, 2)])
def test_what_waits_is_committed_in_groups(start, monkeypatch, waiting, commits):
    events = spied(monkeypatch, "commit")
    writer, replies = start(), Replies()
    with held(writer):
        for i in range(waiting):
            writer.submit(incoming(samples(1), i + 1), replies[i])
    assert [a.watermark for a in replies.wait(waiting)] == list(range(1, waiting + 1))
    assert len(events) == commits


def test_a_failed_commit_refuses_all_and_later_batches_work(start, monkeypatch):
    writer, replies = start(), Replies()
    journal = writer.run(lambda store: store.journal)

    def full():
        raise sqlite3.OperationalError("database or disk is full")

    monkeypatch.setattr(journal, "commit", full)
    with held(writer):
        for i in range(3):
            writer.submit(incoming(samples(2), 1 + 2 * i), replies[i])
    assert [a.reason for a in replies.wait(3)] == [Refusal.STORE] * 3
    assert writer.info()["samples_merged"] == 0
    monkeypatch.undo()
    assert send(writer, [incoming(samples(6))]) == [Ack(6, 1, store=writer.store_id)]
    assert writer.info()["samples_merged"] == 6
    assert writer.info()["counters"]["refused_store"] == 3
    assert not writer.failed


def test_a_full_queue_refuses_at_once_and_is_counted(start):
    writer, waiting, refused = start(), Replies(), Replies()
    with held(writer):
        for i in range(QUEUE_BATCHES):
            writer.submit(incoming(samples(1), i + 1), waiting[i])
        for i in range(2):
            writer.submit(incoming(samples(1), QUEUE_BATCHES + 1), refused[i])
        assert [a.reason for _, a in refused.all] == [Refusal.OVERLOADED] * 2
    waiting.wait(QUEUE_BATCHES)
    assert writer.info()["counters"]["refused_overloaded"] == 2
    assert writer.info()["samples_merged"] == QUEUE_BATCHES
    answers = send(writer, [incoming(samples(1), QUEUE_BATCHES + 1)])
    assert isinstance(answers[0], Ack)  # room again


def test_closing_finishes_what_is_waiting(start, tmp_path):
    writer, replies = start(), Replies()
    with held(writer):
        for i in range(7):
            writer.submit(incoming(samples(1), i + 1), replies[i])
        closing = threading.Thread(target=writer.close)
        closing.start()
    closing.join(WAIT_S)
    assert [a.watermark for a in replies.wait(7)] == [1, 2, 3, 4, 5, 6, 7]
    assert max(snapshot.rows_on_disk(tmp_path)) == 7
    again = start()
    assert again.info()["snapshot"] == again.info()["merged"] == 7


# --- work of other threads -------------------------------------------------------------------------------------------


def test_a_thread_gets_the_error_that_its_work_raised(start):
    writer = start()
    with pytest.raises(ZeroDivisionError):
        writer.run(lambda _: 1 // 0)
    assert not writer.failed


def test_work_runs_on_the_owners_thread(start):
    assert start().run(lambda _: threading.current_thread().name) == "writer"


def test_work_between_batches_is_done_and_sees_those_before(start):
    writer, replies, seen = start(), Replies(), []
    with held(writer):
        writer.submit(incoming(samples(2)), replies[0])
        reader = threading.Thread(target=lambda: seen.append(writer.run(lambda store: store.grid.folded)))
        reader.start()
        wait_for(lambda: writer._batches.qsize() == 2)
        writer.submit(incoming(samples(2), 3), replies[1])
    reader.join(WAIT_S)
    replies.wait(2)
    assert seen[0] >= 2


def test_waiting_for_a_merged_row_returns_once_it_is(start):
    writer, called = start(), Future()
    writer.waits.add(2, WAIT_S, called.set_result)
    send(writer, [incoming(samples(1))])
    assert not called.done()
    send(writer, [incoming(samples(1), 2)])
    assert called.result(WAIT_S) is None


def test_waiting_for_a_row_that_does_not_come_times_out(start):
    writer = start()
    send(writer, [incoming(samples(1))])
    called: Future[QueryError] = Future()
    writer.waits.add(2, 0.01, called.set_result)
    error = called.result(WAIT_S)
    assert (error.reason, str(error)) == (
        Refusal.AFTER_TIMEOUT,
        "journal row 2 is not merged after 0.01 s; merged is 1",
    )


# --- snapshots -------------------------------------------------------------------------------------------------------


def test_a_snapshot_is_made_after_so_many_rows(start, tmp_path):
    writer = start(snapshot_rows=3)
    expected = {0: [], 3: [3], 6: [6, 3]}
    for row in range(1, 8):
        send(writer, [incoming(samples(1), row)])
        writer.info()  # what was due has begun
        wait_for(lambda row=row: snapshot.rows_on_disk(tmp_path) == expected[row // 3 * 3] and writer._snapshot.done())


def test_a_snapshot_that_takes_long_puts_the_next_off_and_the_work_goes_on(start, tmp_path, monkeypatch):
    release, entered, real = threading.Event(), threading.Event(), snapshot.save

    def slow(*args):
        entered.set()
        assert release.wait(WAIT_S)
        return real(*args)

    monkeypatch.setattr(snapshot, "save", slow)
    writer = start(snapshot_rows=2)
    for row in range(1, 7):
        assert send(writer, [incoming(samples(1), row)]) == [Ack(row, row, store=writer.store_id)]
    assert entered.wait(WAIT_S)
    assert snapshot.rows_on_disk(tmp_path) == []
    release.set()
    wait_for(lambda: writer._snapshot.done())
    assert snapshot.rows_on_disk(tmp_path) == [2]
    writer.close()
    assert snapshot.rows_on_disk(tmp_path) == [6, 2]
    assert start().info()["snapshot"] == 6


def test_a_snapshot_is_of_the_moment_at_which_it_was_taken(start, tmp_path, monkeypatch):
    """What is folded while it is written is not in it."""
    release, real = threading.Event(), snapshot.save

    def slow(*args):
        assert release.wait(WAIT_S)
        return real(*args)

    monkeypatch.setattr(snapshot, "save", slow)
    writer = start(snapshot_rows=1)
    parts = np.split(random_samples(60, 14), 3)
    for i, part in enumerate(parts):
        send(writer, [incoming(part, 1 + 20 * i)])
    release.set()
    wait_for(lambda: writer._snapshot.done())
    row, grid = snapshot.load_newest(tmp_path, 3, 1.0, CONFIG.fold)
    assert row == 1
    assert same(grid, folded(parts[0]))


def test_a_snapshot_is_made_after_so_many_seconds_even_if_nothing_comes(start, tmp_path):
    writer = start(snapshot_s=0.02)
    send(writer, [incoming(samples(1))])
    wait_for(lambda: writer.info()["snapshot"] == 1)
    assert snapshot.rows_on_disk(tmp_path) == [1]


def test_no_snapshot_is_made_before_its_time(start, tmp_path):
    writer = start()
    for i in range(5):
        send(writer, [incoming(samples(1), i + 1)])
    assert snapshot.rows_on_disk(tmp_path) == []


def test_a_snapshot_that_fails_is_tried_again_only_when_due(start, tmp_path, monkeypatch):
    tries = []

    def full(*args):
        tries.append(args[1])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(snapshot, "save", full)
    writer = start(snapshot_rows=3)
    for i in range(7):
        assert send(writer, [incoming(samples(1), i + 1)]) == [Ack(i + 1, i + 1, store=writer.store_id)]
        writer.info()
        wait_for(lambda i=i: len(tries) == (i + 1) // 3 and writer._snapshot.done())
    assert tries == [3, 6]
    writer.close()
    assert not writer.failed
    assert tries == [3, 6, 7]


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_bug_in_the_snapshot_is_logged(start, monkeypatch, caplog):
    monkeypatch.setattr(snapshot, "save", lambda *_: 1 // 0)
    writer = start(snapshot_rows=1)
    send(writer, [incoming(samples(1))])
    writer.info()
    wait_for(lambda: writer._snapshot.done())
    assert writer.failed or "snapshot failed" in caplog.text


# --- the end of the thread -------------------------------------------------------------------------------------------


def test_a_bug_in_the_writer_shows_and_leaves_nobody_waiting(start, monkeypatch):
    writer = start()
    assert not writer.failed
    monkeypatch.setattr(Store, "_fold", lambda *_: 1 // 0)
    with held(writer):
        writer.submit(incoming(samples(1)), lambda _: None)
    wait_for(lambda: writer.failed)
    answers = send(writer, [incoming(samples(1))]) + send(writer, [incoming(samples(1))])
    assert [a.reason for a in answers] == [Refusal.STORE] * 2
    with pytest.raises(QueryError, match="restart the server"):
        writer.info()
    writer.close()


def test_closing_after_a_bug_in_the_last_group_ends(start, monkeypatch):
    writer = start()
    monkeypatch.setattr(Store, "_fold", lambda *_: 1 // 0)
    with held(writer):
        writer.submit(incoming(samples(1)), lambda _: None)
        closing = threading.Thread(target=writer.close)
        closing.start()
        wait_for(lambda: writer._batches.qsize() == 2)
    closing.join(WAIT_S)
    assert not closing.is_alive()
    assert writer.failed


def test_after_a_bug_a_restart_folds_what_was_committed(start, monkeypatch, tmp_path):
    writer = start()
    with monkeypatch.context() as patched:
        patched.setattr(Store, "_fold", lambda *_: 1 // 0)
        writer.submit(incoming(samples(4)), lambda _: None)
        wait_for(lambda: writer.failed)
        writer.close()
    assert snapshot.rows_on_disk(tmp_path) == []  # a grid that may be half-folded is not kept
    again = start()
    assert send(again, [incoming(samples(4))]) == [Ack(4, 1, trimmed=4, store=writer.store_id)]
    assert again.info()["samples_merged"] == 4


# --- every refusal has its counter -----------------------------------------------------------------------------------


def table(**fields: Any) -> bytes:
    """A good batch with some fields replaced; None takes one out."""
    good = msgpack.unpackb(encode_batch(batch(samples(2), 1)))
    return msgpack.packb({k: v for k, v in (good | fields).items() if v is not None})


def one(**columns: Any) -> bytes:
    return encode_batch(batch(samples(2, **columns), 1))


WALL = replace(SITE, clock="wall")
BATCHES = [
    (Refusal.TOO_LARGE, b"\0" * (MAX_BATCH_BYTES + 1)),
    (Refusal.TOO_LARGE, table(n=10**6)),
    (Refusal.NOT_MSGPACK, b"\xc1"),
    (Refusal.NOT_MSGPACK, b""),
    (Refusal.NOT_MSGPACK, msgpack.packb([1, 2])),
    (Refusal.VERSION, table(v=2)),
    (Refusal.MISSING_FIELD, table(spool_id=None)),
    (Refusal.WRONG_TYPE, table(n="2")),
    (Refusal.COLUMN_LENGTH, table(n=3)),
    (Refusal.NOT_FINITE, one(x_m=np.nan)),
    (Refusal.NOT_FINITE, one(c_rr=np.nan, c_rr_var=1.0)),
    (Refusal.OUT_OF_RANGE, one(speed_mps=1e4)),
    (Refusal.OUT_OF_RANGE, table(machine="../etc")),
    (Refusal.COVARIANCE, one(cov_xy_m2=1.0)),
    (Refusal.COVARIANCE, one(cov_xx_m2=-1.0)),
    (Refusal.OUTSIDE_SITE, one(y_m=-20_001.0)),
    (Refusal.FIRST_SEQ, table(first_seq=0)),
    (Refusal.GAP, table(first_seq=2)),
    (Refusal.WRONG_FRAME, table(frame="00000000")),
    (Refusal.WRONG_MACHINE, table(machine="b")),
    (Refusal.OTHER_STORE, table(store="0123456789abcdef")),
    (Refusal.OUT_OF_RANGE, table(store="0123")),
    (Refusal.WALL_CLOCK, one(stamp_ns=NOW_NS + 10**13)),
    (Refusal.FAR_FUTURE, one(stamp_ns=NOW_NS + 10**15)),
]


@pytest.mark.parametrize(("reason", "payload"), BATCHES)
def test_a_refused_batch_is_counted_by_its_reason(start, reason, payload):
    writer = start(WALL)
    answer = send(writer, [Incoming("a", payload)])[0]
    assert (answer.reason, answer.expected) == (reason, 1 if reason == Refusal.GAP else 0)
    info = writer.info()
    assert info["counters"][f"refused_{reason}"] == 1
    assert info["journalled"] == 0


QUERIES = [
    (Refusal.UNKNOWN_QUERY, "route", {}),
    (Refusal.UNKNOWN_QUERY, "*", {}),
    (Refusal.UNKNOWN_PARAMETER, "point", {"x": "1", "y": "1", "z": "1"}),
    (Refusal.UNKNOWN_LAYER, "point", {"x": "1", "y": "1", "layers": "grade,colour"}),
    (Refusal.AFTER_TIMEOUT, "info", {"after": "5", "wait": "0.01"}),
    (Refusal.TOO_LARGE, "region", {"bounds": "0,0,5000,5000"}),
    (Refusal.MISSING_FIELD, "point", {"x": "1"}),
    (Refusal.MISSING_FIELD, "region", {"bounds": "1,2,3"}),
    (Refusal.WRONG_TYPE, "point", {"x": "one", "y": "1"}),
    (Refusal.NOT_FINITE, "point", {"x": "nan", "y": "1"}),
    (Refusal.OUT_OF_RANGE, "region", {"bounds": "5,0,4,1"}),
    (Refusal.OUT_OF_RANGE, "info", {"after": "1", "wait": "61"}),
]


@pytest.mark.parametrize(("reason", "name", "parameters"), QUERIES)
def test_a_refused_query_says_why(start, reason, name, parameters):
    with pytest.raises(QueryError) as caught:
        answered(Answers(start(), FakeFollower()), name, parameters)
    assert caught.value.reason == reason


def test_every_reason_to_refuse_is_provoked_here():
    elsewhere = {Refusal.OVERLOADED, Refusal.STORE}  # a full queue and a failed commit, above
    elsewhere |= {Refusal.SERVER_CLOCK, Refusal.NOT_WRITER}  # in the tests of admission, and of the claim
    elsewhere |= {Refusal.UNKNOWN_MACHINE, Refusal.EXPIRED}  # commands and tiles, in the tests of the answers
    assert {reason for reason, _ in BATCHES} | {reason for reason, _, _ in QUERIES} | elsewhere == set(Refusal)


def test_refused_queries_are_counted_by_reason(start):
    writer = start()
    for _ in range(2):
        writer.count_refusal(Refusal.UNKNOWN_LAYER)
    writer.count_refusal(Refusal.TOO_LARGE)
    counters = writer.info()["counters"]
    assert (counters["refused_query_unknown_layer"], counters["refused_query_too_large"]) == (2, 1)
