"""Maps folded again beside the writer: decisions, batches and the end meanwhile; decisions on a full disk."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from threading import Event, Thread
from typing import Any

import pytest

from mapserver.evidence.grid import Grid
from mapserver.fleet.calibration import Calibration
from mapserver.fleet.correction import LAST_NS, Correction
from mapserver.fleet.decisions import EVERY_NS
from mapserver.fleet.observability import CommonScale
from mapserver.ingest.store import Store
from mapserver.ingest.writer import Writer
from mapserver.journal.location import JOURNAL_FILE
from mapserver.journal.sqlite.reader import SqliteReader
from mapserver.past import past
from mapserver.trust.auditor import Verdict
from mapserver.trust.decisions import DISTRUST_AFTER, KIND, PERSON, TrustDecision
from mapserver.trust.judgement import Reason
from mapserver.upkeep.refolding import Refolding
from protocol.errors import QueryError, Refusal
from tests.unit.mapserver.data import (
    CONFIG,
    NOW_NS,
    SITE,
    WAIT_S,
    grid_copy,
    held,
    incoming,
    open_writer,
    past_of,
    random_samples,
    refused,
    same,
    send,
    wait_for,
)

MACHINES = "abcd"
BATCH = 20


class HeldFold:
    """Stands in front of `fold_history`: each fold waits until it may go on. without: of each fold that began."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.without: list[set[str]] = []
        self.rows: list[tuple[int, int]] = []
        self.came_to_an_end: list[bool] = []
        self.may_go_on = Event()
        self._fold = past.fold_history
        monkeypatch.setattr(past, "fold_history", self)

    def __call__(self, grid: Grid, history: Any, after: int, until: int, selection: Any, stopped: Any) -> bool:
        self.without.append(set(selection.without))
        self.rows.append((after, until))
        assert self.may_go_on.wait(WAIT_S)
        self.came_to_an_end.append(self._fold(grid, history, after, until, selection, stopped))
        return self.came_to_an_end[-1]

    def wait(self, folds: int) -> None:
        wait_for(lambda: len(self.without) >= folds)


@pytest.fixture
def fold(monkeypatch: pytest.MonkeyPatch) -> HeldFold:
    return HeldFold(monkeypatch)


@pytest.fixture
def writer(tmp_path: Path) -> Iterator[Writer]:
    with closing(open_writer(tmp_path)) as opened:
        deliver(opened, range(5))
        yield opened


def rows_of(machine: str, number: int) -> Any:
    return random_samples(BATCH, seed=MACHINES.index(machine) + 10 * number)


def deliver(writer: Writer, numbers: range) -> None:
    for number in numbers:
        send(writer, [incoming(rows_of(name, number), 1 + BATCH * number, name) for name in MACHINES])


def map_without(machines: str, batches: int) -> Grid:
    grid = Grid(SITE.cell_m, CONFIG.fold)
    for name in set(MACHINES) - set(machines):
        for number in range(batches):
            grid.fold(rows_of(name, number), name)
    return grid


def decision(machine: str, *, trusted: bool = False, reason: str = "why") -> TrustDecision:
    return TrustDecision(machine, trusted, PERSON, reason, NOW_NS)


def test_batches_are_acknowledged_during_a_fold_and_are_in_the_map_afterwards(writer, fold):
    with closing(Refolding(writer, past_of(writer))) as refolds:
        number = refolds.decide(decision("b"))
        fold.wait(1)
        deliver(writer, range(5, 10))
        assert same(writer.run(grid_copy), map_without("", 10)), "the map answers as it was, with what came in"
        fold.may_go_on.set()
        refolds.wait(number, WAIT_S)
        assert same(writer.run(grid_copy), map_without("b", 10))
        assert fold.rows == [(0, 20), (20, 40)], "what came in was folded beside the writer, too"
        deliver(writer, range(10, 12))
        assert same(writer.run(grid_copy), map_without("b", 12))


def test_where_batches_never_end_the_writer_has_them_wait(writer, monkeypatch):
    monkeypatch.setattr(past, "FEW_ROWS", -1)
    with closing(Refolding(writer, past_of(writer))) as refolds:
        refolds.wait(refolds.decide(decision("b")), WAIT_S)
    assert same(writer.run(grid_copy), map_without("b", 5))


def test_decisions_during_a_fold_are_folded_together_and_the_old_fold_is_given_up(writer, fold):
    with closing(Refolding(writer, past_of(writer))) as refolds:
        first = refolds.decide(decision("b"))
        fold.wait(1)
        refolds.decide(decision("c"))
        last = refolds.decide(decision("d"))
        assert refolds.decision("d") == decision("d"), "it counts at once"
        fold.may_go_on.set()
        for number in (first, last):
            refolds.wait(number, WAIT_S)
        assert fold.without == [{"b"}, {"b", "c", "d"}]
        assert fold.came_to_an_end == [False, True]
        assert same(writer.run(grid_copy), map_without("bcd", 5))


def solved(zero: float) -> Calibration:
    sure = ((1e-7, 0.0, 0.0), (0.0, 1e-5, 0.0), (0.0, 0.0, 1e-7))
    return Calibration((Correction("a", NOW_NS, LAST_NS, zero, 0.0, 0.0, sure),), {}, CommonScale(True, 0.0, ""))


def test_the_solver_decides_nothing_new_until_the_map_follows_unless_it_is_asked(writer, fold):
    with closing(Refolding(writer, past_of(writer))) as refolds:
        refolds.calibrate(solved(0.001), NOW_NS, asked=True)
        fold.wait(1)
        for due in range(1, 10):  # far more often than a map can be folded
            assert refolds.calibrate(solved(0.002), NOW_NS + due * EVERY_NS) == 1
        assert refolds.calibrate(solved(0.003), NOW_NS, asked=True) == 2
        fold.may_go_on.set()
        refolds.wait(2, WAIT_S)
        for due in (10, 11):
            number = refolds.calibrate(solved(0.004), NOW_NS + due * EVERY_NS)
        refolds.wait(number, WAIT_S)
        newest = refolds.facts().corrections.newest("a")
        assert (number, newest and newest.zero) == (3, 0.004)


def test_a_decision_that_is_taken_back_during_its_fold_leaves_the_map(writer, fold):
    before = writer.run(lambda store: store.grid)
    with closing(Refolding(writer, past_of(writer))) as refolds:
        refolds.decide(decision("b"))
        fold.wait(1)
        number = refolds.decide(decision("b", trusted=True))
        fold.may_go_on.set()
        refolds.wait(number, WAIT_S)
        assert fold.came_to_an_end == [False]
        assert writer.run(lambda store: store.grid) is before


def room(store: Store, *, full: bool) -> None:
    """Let the journal's file grow no further, as on a full disk."""
    store.journal._db.execute(f"PRAGMA max_page_count={1 if full else 2**30}")  # 1: the file as large as it is


def test_a_decision_that_cannot_be_written_does_not_count_and_is_said_so(writer, tmp_path):
    long = decision("b", reason="a reason that needs new pages" * 1000)
    before = writer.run(lambda store: store.grid)
    with closing(Refolding(writer, past_of(writer))) as refolds, SqliteReader(tmp_path / JOURNAL_FILE) as reader:
        writer.run(lambda store: room(store, full=True))
        with refused(Refusal.STORE, r"cannot be written, so it does not count: .*full; make room"):
            refolds.decide(long)
        assert (refolds.decision("b"), refolds.facts().excluded, reader.events(KIND)) == (None, frozenset(), [])
        assert writer.run(lambda store: store.grid) is before
        writer.run(lambda store: room(store, full=False))
        refolds.wait(refolds.decide(long), WAIT_S)
        assert refolds.facts().excluded == {"b"}
        assert [event.body["machine"] for event in reader.events(KIND)] == ["b"]
        deliver(writer, range(5, 6))
    assert same(writer.run(grid_copy), map_without("b", 6))


def test_a_person_is_not_overruled_by_an_audit_that_judged_at_the_same_time(writer):
    bad = {"b": Verdict("b", (Reason.GAIN,), {}, True)}
    with closing(Refolding(writer, past_of(writer))) as refolds:
        for _ in range(DISTRUST_AFTER - 1):
            refolds.judge(bad, NOW_NS)
        person = Thread(target=refolds.decide, args=(decision("b", trusted=True),))
        judge = Thread(target=refolds.judge, args=(bad, NOW_NS))
        with held(writer):  # both wait for the writer's thread
            person.start()
            judge.start()
        for thread in (person, judge):
            thread.join(WAIT_S)
        assert refolds.decision("b") == decision("b", trusted=True)
        wait_for(lambda: refolds.facts().excluded == frozenset())


def test_a_decision_that_the_writer_has_no_time_for_is_not_said_to_be_refused(writer, monkeypatch):
    run = writer.run
    with closing(Refolding(writer, past_of(writer))) as refolds:
        with held(writer), monkeypatch.context() as patch:
            patch.setattr(writer, "run", lambda work: run(work, timeout_s=0.01))
            with pytest.raises(QueryError, match="may still do so") as refused:
                refolds.decide(decision("b"))
        assert refused.value.reason == Refusal.AFTER_TIMEOUT
        wait_for(lambda: refolds.decision("b") == decision("b"))
