"""Refolds beside the writer, after trust decisions and corrections: all are one fold, bit for bit."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from threading import Event, Thread
from typing import Any

import numpy as np
import pytest

from mapserver.calibration.calibrate import Solution
from mapserver.calibration.correction import LAST_NS, LEVEL_SHARE, Correction
from mapserver.calibration.decide import EVERY_NS
from mapserver.calibration.decision import SOLVER, CalibrationDecision
from mapserver.calibration.select import CommonScale
from mapserver.change.change_log import ChangeLog
from mapserver.change.detection import reach_blocks
from mapserver.change.validity import around
from mapserver.evidence.grid import Grid
from mapserver.ingest.store import Store
from mapserver.ingest.writer import Writer
from mapserver.journal.location import JOURNAL_FILE
from mapserver.journal.sqlite.reader import SqliteReader
from mapserver.past import past
from mapserver.past.checkpoint_file import Checkpoint
from mapserver.past.making import make
from mapserver.trust.auditor import Verdict
from mapserver.trust.decisions import DISTRUST_AFTER, KIND, PERSON, TrustDecision
from mapserver.trust.judgement import Reason
from mapserver.upkeep.refolding import Refolding
from protocol.arrays import Table
from protocol.errors import QueryError, Refusal
from protocol.units import HOUR_NS
from tests.patience import PATIENCE_S
from tests.reference.correction import in_numpy
from tests.reference.grid import by_definition, of_grid, plain
from tests.unit.mapserver.data import (
    CONFIG,
    NOW_NS,
    SITE,
    grid_copy,
    held,
    incoming,
    open_store,
    open_writer,
    past_of,
    random_samples,
    refused,
    same,
    samples,
    send,
    wait_for,
)

MACHINES = "abcd"
BATCH = 20


class HeldFold:
    """Holds each `fold_history` until released. without: of each fold begun."""

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
        assert self.may_go_on.wait(PATIENCE_S)
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
        refolds.wait(number, PATIENCE_S)
        assert same(writer.run(grid_copy), map_without("b", 10))
        assert fold.rows == [(0, 20), (20, 40)], "what came in was folded beside the writer, too"
        deliver(writer, range(10, 12))
        assert same(writer.run(grid_copy), map_without("b", 12))


def test_decisions_during_a_fold_are_folded_together_and_the_old_fold_is_given_up(writer, fold):
    with closing(Refolding(writer, past_of(writer))) as refolds:
        first = refolds.decide(decision("b"))
        fold.wait(1)
        refolds.decide(decision("c"))
        last = refolds.decide(decision("d"))
        assert refolds.decision("d") == decision("d"), "it counts at once"
        fold.may_go_on.set()
        for number in (first, last):
            refolds.wait(number, PATIENCE_S)
        assert fold.without == [{"b"}, {"b", "c", "d"}]
        assert fold.came_to_an_end == [False, True]
        assert same(writer.run(grid_copy), map_without("bcd", 5))


def solved(zero: float) -> Solution:
    sure = ((1e-7, 0.0, 0.0), (0.0, 1e-5, 0.0), (0.0, 0.0, 1e-7))
    return Solution((Correction("a", NOW_NS, LAST_NS, zero, 0.0, 0.0, sure),), {}, CommonScale(True, 0.0, ""))


def test_the_solver_decides_nothing_new_until_the_map_follows_unless_it_is_asked(writer, fold):
    with closing(Refolding(writer, past_of(writer))) as refolds:
        refolds.calibrate(solved(0.001), NOW_NS, asked=True)
        fold.wait(1)
        for due in range(1, 10):  # far more often than folds
            assert refolds.calibrate(solved(0.002), NOW_NS + due * EVERY_NS) == 1
        assert refolds.calibrate(solved(0.003), NOW_NS, asked=True) == 2
        fold.may_go_on.set()
        refolds.wait(2, PATIENCE_S)
        for due in (10, 11):
            number = refolds.calibrate(solved(0.004), NOW_NS + due * EVERY_NS)
        refolds.wait(number, PATIENCE_S)
        newest = refolds.facts().corrections.newest("a")
        assert (number, newest and newest.zero) == (3, 0.004)


def test_decisions_that_come_faster_than_folds_do_not_keep_the_map_from_following(writer, monkeypatch):
    folds: list[bool] = []

    def fold(*arguments: Any) -> bool:
        refolds.calibrate(solved(0.001 * (len(folds) + 1)), NOW_NS, asked=True)  # during each fold
        folds.append(refolding_fold(*arguments))
        return folds[-1]

    refolding_fold = past.fold_history
    monkeypatch.setattr(past, "fold_history", fold)
    with closing(Refolding(writer, past_of(writer))) as refolds:
        refolds.wait(refolds.decide(decision("b")), PATIENCE_S)
        wait_for(lambda: len(folds) >= 6)
        assert folds[:6] == [False, True] * 3
        assert refolds.facts().excluded == {"b"}


def test_a_decision_that_is_taken_back_during_its_fold_leaves_the_map(writer, fold):
    before = writer.run(lambda store: store.grid)
    with closing(Refolding(writer, past_of(writer))) as refolds:
        refolds.decide(decision("b"))
        fold.wait(1)
        number = refolds.decide(decision("b", trusted=True))
        fold.may_go_on.set()
        refolds.wait(number, PATIENCE_S)
        assert fold.came_to_an_end == [False]
        assert writer.run(lambda store: store.grid) is before


def room(store: Store, *, full: bool) -> None:
    """Fill or free the journal's disk."""
    store.journal._db.execute(f"PRAGMA max_page_count={1 if full else 2**30}")  # 1: as large as it is


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
        refolds.wait(refolds.decide(long), PATIENCE_S)
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
            thread.join(PATIENCE_S)
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


DRIVERS = "abc"
END_NS = 2**62
S = 10**9
MADE = (
    Correction("a", 0, NOW_NS + 700 * S, 0.02, 0.05, -0.01, ()),
    Correction("a", NOW_NS + 700 * S, END_NS, -0.03, 0.0, 0.0, (), LEVEL_SHARE),
    Correction("b", NOW_NS + 300 * S, NOW_NS + 1200 * S, 0.01, -0.2, 0.02, ()),
)


def correction_of(machine: str, corrections: tuple[Correction, ...] = MADE, by: str = SOLVER) -> CalibrationDecision:
    return CalibrationDecision(machine, by, "", NOW_NS, tuple(one for one in corrections if one.machine == machine))


def by_reference(rows: Table, machine: str, corrections: tuple[Correction, ...]) -> Table:
    out = rows.copy()
    for one in corrections:
        hit = (rows["stamp_ns"] >= one.from_ns) & (rows["stamp_ns"] < one.to_ns) & (one.machine == machine)
        out[hit] = in_numpy(rows[hit], one)
    return out


class Fleet:
    def __init__(self, seed: int, n: int = 900) -> None:
        self.draw = np.random.default_rng(seed)
        self.rows = {name: random_samples(n, seed=100 * seed + i, half_m=25.0) for i, name in enumerate(DRIVERS)}
        for rows in self.rows.values():
            rows["speed_mps"] = self.draw.choice([-1.0, 1.0], n)
        self.left = {name: self._cut(n) for name in DRIVERS}

    def _cut(self, n: int) -> list[slice]:
        ends = np.unique(np.r_[0, self.draw.integers(1, n, 12), n]).tolist()
        return [slice(*ends) for ends in pairwise(ends)]

    def send(self, empty_writer: Writer, batches: int) -> None:
        for _ in range(batches):
            name = self.draw.choice([each for each in DRIVERS if self.left[each]])
            part = self.left[name].pop(0)
            send(empty_writer, [incoming(self.rows[name][part], part.start + 1, name)])

    def sent(self, name: str) -> Table:
        return self.rows[name][: self.left[name][0].start if self.left[name] else None]

    def folded(self, corrections: tuple[Correction, ...], to_ns: int = END_NS, without: str = "") -> Grid:
        grid = Grid(SITE.cell_m, CONFIG.fold)
        for name in sorted(set(DRIVERS) - set(without)):
            rows = by_reference(self.sent(name), name, corrections)
            grid.fold(rows[rows["stamp_ns"] <= to_ns], name)
        return grid


@pytest.fixture
def empty_writer(tmp_path: Path) -> Iterator[Writer]:
    with closing(open_writer(tmp_path)) as opened:
        yield opened


@pytest.mark.slow
def test_any_batching_any_order_and_any_time_of_the_decision_give_one_map(empty_writer, tmp_path):
    fleet = Fleet(1)
    with closing(Refolding(empty_writer, past_of(empty_writer))) as refolds:
        fleet.send(empty_writer, int(fleet.draw.integers(1, 20)))
        refolds.wait(refolds.decide(correction_of("a")), PATIENCE_S)
        assert same(empty_writer.run(grid_copy), fleet.folded(correction_of("a").corrections))
        fleet.send(empty_writer, 6)
        number = refolds.decide(correction_of("b"))
        fleet.send(empty_writer, 6)
        refolds.wait(number, PATIENCE_S)
        live = empty_writer.run(grid_copy)
        assert same(live, fleet.folded(MADE))
        assert empty_writer.run(lambda store: store.version.fact) == 2
        reference = [(name, by_reference(fleet.sent(name), name, MADE)) for name in DRIVERS]
        assert plain(of_grid(live)) == plain(by_definition(reference, SITE.cell_m, CONFIG.fold))
    empty_writer.close()
    for path in tmp_path.glob("snapshot-*"):
        path.unlink()
    with closing(open_store(tmp_path)) as store:
        assert same(store.grid, live)
        assert store.fact == 2


def test_a_correction_of_a_machine_that_is_left_out_folds_nothing_and_counts_when_it_comes_back(empty_writer):
    fleet = Fleet(8)
    fleet.send(empty_writer, 12)
    with closing(Refolding(empty_writer, past_of(empty_writer))) as refolds:
        refolds.wait(refolds.decide(TrustDecision("b", False, PERSON, "why", NOW_NS)), PATIENCE_S)
        grid = empty_writer.run(lambda store: store.grid)
        refolds.wait(refolds.decide(correction_of("b")), PATIENCE_S)
        assert empty_writer.run(lambda store: store.grid) is grid
        assert empty_writer.run(lambda store: store.fact) == 2
        refolds.wait(refolds.decide(TrustDecision("b", True, PERSON, "mended", NOW_NS)), PATIENCE_S)
        assert same(empty_writer.run(grid_copy), fleet.folded(correction_of("b").corrections))


def test_maps_of_the_past_have_the_facts_of_now_and_a_checkpoint_that_lacks_them_is_not_used(empty_writer):
    fleet, past = Fleet(9), past_of(empty_writer)
    for name in DRIVERS:
        fleet.rows[name]["stamp_ns"] += np.arange(900) // 300 * HOUR_NS
    fleet.send(empty_writer, 30)
    later = tuple(replace(one, from_ns=one.from_ns and one.from_ns + HOUR_NS) for one in MADE[1:])
    later = tuple(replace(one, to_ns=max(one.to_ns, one.from_ns + HOUR_NS)) for one in later)
    with (
        closing(Refolding(empty_writer, past)) as refolds,
        SqliteReader(empty_writer.location.folder / JOURNAL_FILE) as reader,
    ):
        for hour in (1, 2, 3):
            assert list(make(past, reader, NOW_NS + hour * HOUR_NS, empty_writer.run(lambda store: store.facts)))
        for name in "ab":
            refolds.wait(refolds.decide(correction_of(name, later)), PATIENCE_S)
        facts = empty_writer.run(lambda store: store.facts)
        entries = past.checkpoints.entries(past.depends_on(reader, facts), reader.last_row)
        assert [entry.usable for entry in entries] == [True, False, False], "an hour that they do not touch stays"
        for hours in (0.4, 1.0, 1.3, 2.2, 5.0):
            to_ns = NOW_NS + round(hours * HOUR_NS)
            assert same(past.grid_as_of(reader, to_ns, facts=facts), fleet.folded(later, to_ns))
        assert same(empty_writer.run(grid_copy), fleet.folded(later))
        assert list(make(past, reader, NOW_NS + 2 * HOUR_NS, facts))
        assert same(
            past.grid_as_of(reader, NOW_NS + 2 * HOUR_NS, facts=facts), fleet.folded(later, NOW_NS + 2 * HOUR_NS)
        )


def test_a_snapshot_that_lacks_a_fact_is_folded_again(tmp_path):
    fleet = Fleet(11)
    with closing(open_writer(tmp_path)) as empty_writer:
        fleet.send(empty_writer, 15)
    files = tmp_path.glob("snapshot-*")  # a slow machine may have made one before
    old = max(files, key=lambda path: int(path.stem.removeprefix("snapshot-")))
    with Checkpoint(old) as checkpoint:
        assert checkpoint.header.facts["excluded"] == []
    with closing(open_store(tmp_path)) as store:
        store.decide(correction_of("a"))
        assert store.fact == 0, "killed before the map was folded again"
    with closing(open_store(tmp_path)) as store:
        assert same(store.grid, fleet.folded(correction_of("a").corrections))
        assert (store.snapshot_row, store.fact) == (0, 1)
        store.save_snapshot()
    with closing(open_store(tmp_path)) as store:
        assert store.snapshot_row == store.merged, "the new one has it"
        assert same(store.grid, fleet.folded(correction_of("a").corrections))


def looked(log: ChangeLog, grid: Grid) -> list[object]:
    """Changes found in all folds since the last look."""
    blocks = grid.take_touched(10_000)
    wide = sorted({near for block in blocks for near in around(block, reach_blocks(SITE.cell_m, CONFIG.change))})
    pages = {block: pages for block, pages in zip(wide, grid.pages(wide), strict=True) if pages}
    return list(log.look(blocks, pages))


def passes(c_rr: float, hours: range, zero: float) -> Table:
    """Many passes over 24 by 24 cells by a machine with this zero."""
    x, y = (v.ravel() + 0.5 for v in np.meshgrid(np.arange(24), np.arange(24)))
    parts = []
    for hour in hours:
        draw = np.random.default_rng(hour)
        measured = c_rr + zero + draw.normal(0, 0.002, len(x))
        stamps = NOW_NS + hour * HOUR_NS + np.arange(len(x)) * S
        values = {"x_m": x, "y_m": y, "stamp_ns": stamps, "c_rr": measured, "grade_e": -zero, "grade_n": 0.0}
        parts.append(samples(len(x), speed_mps=1.0, heading_rad=0.0, **values))
    return np.concatenate(parts)


@pytest.mark.slow
def test_a_correction_is_never_taken_for_a_change_of_the_ground_and_hides_none(writer):
    zero = 0.12  # large enough to change the class
    log = ChangeLog(SITE.cell_m, CONFIG.change, CONFIG.read)
    gravel, paved = passes(0.2, range(4), zero), passes(0.02, range(5, 9), zero)
    send(writer, [incoming(gravel)])
    assert writer.run(lambda store: looked(log, store.grid)) == []
    with closing(Refolding(writer, past_of(writer))) as refolds:
        fact = CalibrationDecision("a", SOLVER, "", NOW_NS, (Correction("a", 0, END_NS, zero, 0.0, 0.0, ()),))
        refolds.wait(refolds.decide(fact), PATIENCE_S)
        assert writer.run(lambda store: looked(log, store.grid)) == [], "all was folded again, and nothing changed"
        send(writer, [incoming(paved[: len(paved) // 2], 1 + len(gravel))])
        refolds.wait(refolds.decide(replace(fact, corrections=(replace(fact.corrections[0], zero=0.119),))), PATIENCE_S)
        send(writer, [incoming(paved[len(paved) // 2 :], 1 + len(gravel) + len(paved) // 2)])
        found_changes = writer.run(lambda store: looked(log, store.grid))
    assert found_changes
    assert found_changes[-1].resistance_before == pytest.approx(0.2, rel=0.15)
    assert found_changes[-1].resistance_after == pytest.approx(0.02, rel=0.3)
    assert found_changes[-1].cells > 400
