import math
import threading
import time
from collections import Counter
from concurrent.futures import Future
from contextlib import closing
from dataclasses import replace
from typing import Any

import msgpack
import numpy as np
import pytest

from mapserver.config import ServerConfig, StoreConfig
from mapserver.ingest import backlog, merge_waits
from mapserver.ingest import writer as writer_module
from mapserver.ingest.backlog import BATCH_BYTES, GROUP_BATCHES, GROUP_BYTES, MOST_RETRY_S, Backlog, WorkRate
from mapserver.ingest.merge_waits import MergeWaits
from mapserver.ingest.store import Store
from mapserver.ingest.writer import HANGS_S, Writer
from mapserver.journal.sqlite.journal import SqliteJournal
from mapserver.past.checkpoints import snapshot_rows
from protocol.errors import QueryError, Refusal
from protocol.queries.answers import ServerAlive
from protocol.wire.codec import MAX_BATCH_BYTES, encode_batch
from protocol.wire.messages import Ack
from tests.patience import PATIENCE_S
from tests.unit.mapserver.data import (
    NOW_NS,
    SITE,
    Incoming,
    Replies,
    batch,
    folded,
    held,
    incoming,
    open_writer,
    random_samples,
    refused,
    same,
    samples,
    send,
    wait_for,
)


@pytest.fixture
def start(tmp_path):
    writers = []

    def start_writer(site=SITE, clock=time.monotonic, **options: Any) -> Writer:
        writers.append(open_writer(tmp_path, ServerConfig(store=StoreConfig(**options)), site, clock))
        return writers[-1]

    yield start_writer
    for writer in writers:
        writer.close()


def spied(monkeypatch, method: str) -> list[str]:
    """Record the calls of a Journal method; tests may add side effects."""
    events: list[str] = []
    real = getattr(SqliteJournal, method)

    def spy(self, *args):
        result = real(self, *args)
        events.append(method)
        return result

    monkeypatch.setattr(SqliteJournal, method, spy)
    return events


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
    assert done.wait(PATIENCE_S)
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


def test_batches_that_follow_closely_are_committed_together_and_keep_no_work_waiting(start, monkeypatch):
    monkeypatch.setattr(writer_module, "COMMIT_EVERY_S", 0.3)
    events = spied(monkeypatch, "commit")
    writer, replies = start(clock=Clock()), Replies()
    assert isinstance(send(writer, [incoming(samples(1))])[0], Ack)  # at once: no commit before
    for i in (1, 2, 3):
        writer.submit(incoming(samples(1), i + 1), replies[i])
    assert writer.run(lambda store: store.journalled) == 1
    assert [answer.watermark for answer in replies.wait(3)] == [2, 3, 4]
    assert len(events) == 2
    writer.submit(incoming(samples(1), 5), replies[5])
    writer.close()
    assert replies.wait(4)[-1].watermark == 5


def test_where_too_much_waits_a_batch_is_refused_at_once_and_told_when_to_come_again(start, monkeypatch):
    batches = [incoming(samples(1), i + 1) for i in range(12)]
    room = 10 * (len(batches[0].payload) + BATCH_BYTES)
    monkeypatch.setattr(backlog.Backlog.__init__, "__defaults__", (room,))
    writer, waiting, refused = start(), Replies(), Replies()
    with held(writer):
        for i, each in enumerate(batches[:10]):
            writer.submit(each, waiting[i])
        for i, each in enumerate(batches[10:]):
            writer.submit(each, refused[i])
        assert [answer.reason for _, answer in refused.all] == [Refusal.OVERLOADED] * 2
        assert all(0 < answer.retry_after_s < MOST_RETRY_S for _, answer in refused.all)
    waiting.wait(10)
    info = writer.info()
    assert (info["counters"]["refused_overloaded"], info["samples_merged"]) == (2, 10)
    assert (info["writer"]["waiting"], info["writer"]["waiting_bytes"]) == (0, 0)
    assert isinstance(send(writer, [batches[10]])[0], Ack)  # room again


def test_closing_finishes_what_is_waiting(start, tmp_path):
    writer, replies = start(), Replies()
    with held(writer):
        for i in range(7):
            writer.submit(incoming(samples(1), i + 1), replies[i])
        closing = threading.Thread(target=writer.close)
        closing.start()
    closing.join(PATIENCE_S)
    assert [a.watermark for a in replies.wait(7)] == [1, 2, 3, 4, 5, 6, 7]
    assert max(snapshot_rows(tmp_path)) == 7
    again = start()
    assert again.info()["snapshot"] == again.info()["merged"] == 7


def test_a_look_is_taken_by_whoever_asks_while_the_owner_waits(start):
    writer = start()
    send(writer, [incoming(samples(3))])
    here = writer.look(lambda store: (threading.get_ident(), store.merged))
    while here[0] != threading.get_ident():  # until the owner waits again
        here = writer.look(lambda store: (threading.get_ident(), store.merged))
    assert here == (threading.get_ident(), 1)
    with pytest.raises(ZeroDivisionError):
        writer.look(lambda _: 1 / 0)


def test_nobody_looks_while_the_owner_commits(start, monkeypatch):
    """Concurrent batches and looks: nobody sees a half-made map."""
    writer, both, ended = start(), list[tuple[int, int]](), threading.Event()

    def look() -> None:
        while not ended.is_set():
            both.append(writer.look(lambda store: (store.merged, store.grid.folded)))

    askers = [threading.Thread(target=look) for _ in range(3)]
    for asker in askers:
        asker.start()
    for number in range(30):
        send(writer, [incoming(samples(2), first_seq=1 + 2 * number)])
    ended.set()
    for asker in askers:
        asker.join(PATIENCE_S)
    assert both
    assert all(folded == 2 * merged for merged, folded in both)


class Clock:
    def __init__(self) -> None:
        self.now_s = 1000.0

    def __call__(self) -> float:
        return self.now_s


def turn(writer: Writer) -> None:
    for _ in range(2):
        writer.run(lambda _: None)


def test_a_probe_waits_for_nobody_and_hears_of_a_writer_that_hangs(start):
    clock = Clock()
    writer = start(clock=clock)
    send(writer, [incoming(samples(3))])
    turn(writer)
    with held(writer):
        clock.now_s += HANGS_S
        assert writer.alive() == ServerAlive(writer.store_id, 1, 1, HANGS_S)
        clock.now_s += 1.0
        with refused(Refusal.STORE, "at one piece of work for 31 s"):
            writer.alive()
    turn(writer)
    writer.close()
    with pytest.raises(QueryError, match="the server is ending"):
        writer.alive()


def test_what_comes_after_the_end_is_refused_at_once(start):
    writer = start()
    writer.close()
    assert [answer.reason for answer in send(writer, [incoming(samples(1))])] == [Refusal.STORE]
    for ask in (writer.run, writer.look):
        with pytest.raises(QueryError, match="the server is ending"):
            ask(lambda _: None)


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


def test_after_a_bug_a_restart_folds_what_was_committed(start, monkeypatch, tmp_path):
    writer = start()
    with monkeypatch.context() as patched:
        patched.setattr(Store, "_fold", lambda *_: 1 // 0)
        writer.submit(incoming(samples(4)), lambda _: None)
        wait_for(lambda: writer.failed)
        writer.close()
    assert snapshot_rows(tmp_path) == []  # a half-folded grid is dropped
    again = start()
    assert send(again, [incoming(samples(4))]) == [Ack(4, 1, trimmed=4, store=writer.store_id)]
    assert again.info()["samples_merged"] == 4


def table(**fields: Any) -> bytes:
    """A valid batch with replaced fields; None removes one."""
    good = msgpack.unpackb(encode_batch(batch(samples(2), 1)))
    return msgpack.packb({k: v for k, v in (good | fields).items() if v is not None})


def one(**columns: Any) -> bytes:
    return encode_batch(batch(samples(2, **columns), 1))


WALL = replace(SITE, clock="wall")
BATCHES = [
    (Refusal.TOO_LARGE, b"\0" * (MAX_BATCH_BYTES + 1)),
    (Refusal.NOT_MSGPACK, b"\xc1"),
    (Refusal.VERSION, table(v=2)),
    (Refusal.MISSING_FIELD, table(spool_id=None)),
    (Refusal.WRONG_TYPE, table(n="2")),
    (Refusal.COLUMN_LENGTH, table(n=3)),
    (Refusal.NOT_FINITE, one(x_m=np.nan)),
    (Refusal.OUT_OF_RANGE, one(speed_mps=1e4)),
    (Refusal.COVARIANCE, one(cov_xy_m2=1.0)),
    (Refusal.OUTSIDE_SITE, one(y_m=-20_001.0)),
    (Refusal.FIRST_SEQ, table(first_seq=0)),
    (Refusal.GAP, table(first_seq=2)),
    (Refusal.WRONG_FRAME, table(frame="00000000")),
    (Refusal.WRONG_MACHINE, table(machine="b")),
    (Refusal.OTHER_STORE, table(store="0123456789abcdef")),
    (Refusal.WALL_CLOCK, one(stamp_ns=NOW_NS + 10**13)),
    (Refusal.FAR_FUTURE, one(stamp_ns=NOW_NS + 10**15)),
    (Refusal.SCATTERED, encode_batch(batch(samples(400, stamp_ns=NOW_NS, x_m=40.0 * np.arange(400))))),
]


@pytest.mark.parametrize(("reason", "payload"), BATCHES)
def test_a_refused_batch_is_counted_by_its_reason(start, reason, payload):
    writer = start(WALL)
    answer = send(writer, [Incoming("a", payload)])[0]
    assert (answer.reason, answer.expected) == (reason, 1 if reason == Refusal.GAP else 0)
    info = writer.info()
    assert info["counters"][f"refused_{reason}"] == 1
    assert info["journalled"] == 0


def filled(batches: str, size: int = 10, limit: int = 10**9) -> Backlog[str]:
    backlog, sent = Backlog(limit), Counter()
    for machine in batches:
        sent[machine] += 1
        backlog.add(machine, size, f"{machine}{sent[machine]}")
    return backlog


def test_who_has_had_a_turn_comes_after_those_who_wait():
    backlog = filled("a" * 2 * GROUP_BATCHES + "b")
    first = backlog.take()
    assert (len(first), first[:3]) == (GROUP_BATCHES, ["a1", "b1", "a2"])
    backlog.add("c", 10, "c1")
    assert backlog.take()[:2] == [f"a{GROUP_BATCHES}", "c1"]


def test_a_group_is_bounded_in_bytes_and_never_empty():
    backlog = filled("abc", GROUP_BYTES // 2)
    assert backlog.take() == ["a1", "b1"]
    assert filled("ab", 2 * GROUP_BYTES).take() == ["a1"]


def test_the_newest_of_the_machine_with_most_bytes_gives_way():
    backlog = filled("aaab", limit=40)
    assert backlog.add("c", 10, "c1") == ["a3"]
    assert backlog.add("c", 10, "c2") == ["c2"]  # as much as anybody
    assert backlog.add("d", 10, "d1") == ["a2"]
    assert backlog.add("e", 10, "e1") == ["e1"]  # one each
    assert backlog.take() == ["a1", "b1", "c1", "d1"]


def test_a_batch_larger_than_all_room_is_not_taken_and_takes_nobodys_place():
    backlog = filled("ab", limit=40)
    assert backlog.add("c", 41, "c1") == ["c1"]
    assert backlog.take() == ["a1", "b1"]


def test_the_time_until_there_is_room_follows_the_pace():
    pace = WorkRate()
    for _ in range(100):
        pace.worked(2_000_000, 0.5)
    assert 0.9 < pace.retry_after_s(4_000_000) < 1.1
    pace.worked(1, 0.0)  # a stopped clock
    assert pace.retry_after_s(10**12) == MOST_RETRY_S


@pytest.fixture
def waits():
    with closing(MergeWaits(5)) as made:
        yield made


def added(waits: MergeWaits, row: int, wait_s: float = PATIENCE_S) -> Future:
    called: Future[QueryError | None] = Future()
    if not waits.add(row, wait_s, called.set_result):
        called.set_result(None)
    return called


def test_rows_call_back_as_they_are_merged_in_any_order(waits):
    later, sooner = added(waits, 9), added(waits, 7)
    waits.advance(6)
    waits.advance(7)
    assert sooner.result(PATIENCE_S) is None
    assert not later.done()
    waits.advance(12)
    assert later.result(PATIENCE_S) is None


def test_a_wait_that_is_over_is_told_so_and_when_the_next_one_is(waits):
    assert waits.time_out() == math.inf
    over, waiting = added(waits, 7, 0.0), added(waits, 7)
    assert 0.0 < waits.time_out() <= PATIENCE_S
    assert over.result(0).reason == Refusal.AFTER_TIMEOUT
    waits.advance(7)
    assert waiting.result(0) is None
    assert waits.time_out() == math.inf


def test_waits_are_bounded_and_room_comes_back(waits, monkeypatch):
    monkeypatch.setattr(merge_waits, "MOST_WAITING", 2)
    first = [added(waits, 6), added(waits, 6)]
    with pytest.raises(QueryError, match="too many queries wait") as caught:
        added(waits, 6)
    assert caught.value.reason == Refusal.OVERLOADED
    assert caught.value.retry_after_s > 0
    assert added(waits, 5).done(), "which waits for nothing"
    waits.advance(6)
    assert [one.result(PATIENCE_S) for one in first] == [None, None]
    assert not added(waits, 7).done()
