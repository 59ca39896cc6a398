"""Maps of corrected samples: live, folded again, of the past, after a start; all are one fold, bit for bit."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from mapserver.change.change_log import ChangeLog
from mapserver.change.detection import reach_blocks
from mapserver.change.validity import around
from mapserver.evidence import snapshot
from mapserver.evidence.grid import Grid
from mapserver.fleet.correction import LEVEL_SHARE, Correction, Corrections
from mapserver.fleet.decisions import PERSON, SOLVER, CalibrationDecision
from mapserver.ingest.writer import Writer
from mapserver.journal.facts import Facts
from mapserver.journal.location import JOURNAL_FILE
from mapserver.journal.rows import Selection
from mapserver.journal.sqlite.reader import SqliteReader
from mapserver.past.cell_history import cell_history
from mapserver.past.making import make
from mapserver.past.plan import HOUR_NS
from mapserver.trust.decisions import TrustDecision
from mapserver.upkeep.refolding import Refolding
from protocol.arrays import Table
from tests.reference.correction import in_numpy
from tests.reference.grid import by_definition, of_grid, plain
from tests.unit.mapserver.data import (
    CONFIG,
    NOW_NS,
    SITE,
    WAIT_S,
    grid_copy,
    incoming,
    open_store,
    open_writer,
    past_of,
    random_samples,
    same,
    samples,
    send,
)

MACHINES = "abc"
END_NS = 2**62
S = 10**9
MADE = (
    Correction("a", 0, NOW_NS + 700 * S, 0.02, 0.05, -0.01, ()),
    Correction("a", NOW_NS + 700 * S, END_NS, -0.03, 0.0, 0.0, (), LEVEL_SHARE),
    Correction("b", NOW_NS + 300 * S, NOW_NS + 1200 * S, 0.01, -0.2, 0.02, ()),
)


def decision(machine: str, corrections: tuple[Correction, ...] = MADE, by: str = SOLVER) -> CalibrationDecision:
    return CalibrationDecision(machine, by, "", NOW_NS, tuple(one for one in corrections if one.machine == machine))


def by_reference(rows: Table, machine: str, corrections: tuple[Correction, ...]) -> Table:
    """Samples corrected one by one, in numpy."""
    out = rows.copy()
    for one in corrections:
        hit = (rows["stamp_ns"] >= one.from_ns) & (rows["stamp_ns"] < one.to_ns) & (one.machine == machine)
        out[hit] = in_numpy(rows[hit], one)
    return out


class Fleet:
    """Random samples of three machines, sent in random batches in a random order."""

    def __init__(self, seed: int, n: int = 900) -> None:
        self.draw = np.random.default_rng(seed)
        self.rows = {name: random_samples(n, seed=100 * seed + i, half_m=25.0) for i, name in enumerate(MACHINES)}
        for rows in self.rows.values():
            rows["speed_mps"] = self.draw.choice([-1.0, 1.0], n)
        self.left = {name: self._cut(n) for name in MACHINES}

    def _cut(self, n: int) -> list[slice]:
        ends = np.unique(np.r_[0, self.draw.integers(1, n, 12), n]).tolist()
        return [slice(*ends) for ends in pairwise(ends)]

    def send(self, writer: Writer, batches: int) -> None:
        """Some more of the batches."""
        for _ in range(batches):
            name = self.draw.choice([each for each in MACHINES if self.left[each]])
            part = self.left[name].pop(0)
            send(writer, [incoming(self.rows[name][part], part.start + 1, name)])

    def sent(self, name: str) -> Table:
        return self.rows[name][: self.left[name][0].start if self.left[name] else None]

    def folded(self, corrections: tuple[Correction, ...], to_ns: int = END_NS, without: str = "") -> Grid:
        """The fold of what was sent, from the start, corrected in numpy."""
        grid = Grid(SITE.cell_m, CONFIG.fold)
        for name in sorted(set(MACHINES) - set(without)):
            rows = by_reference(self.sent(name), name, corrections)
            grid.fold(rows[rows["stamp_ns"] <= to_ns], name)
        return grid


@pytest.fixture
def writer(tmp_path: Path) -> Iterator[Writer]:
    with closing(open_writer(tmp_path)) as opened:
        yield opened


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_any_batching_any_order_and_any_time_of_the_decision_give_one_map(writer, tmp_path, seed):
    fleet = Fleet(seed)
    with closing(Refolding(writer, past_of(writer))) as refolds:
        fleet.send(writer, int(fleet.draw.integers(1, 20)))
        refolds.wait(refolds.decide(decision("a")), WAIT_S)
        assert same(writer.run(grid_copy), fleet.folded(decision("a").corrections))
        fleet.send(writer, 6)
        number = refolds.decide(decision("b"))
        fleet.send(writer, 6)
        refolds.wait(number, WAIT_S)
        live = writer.run(grid_copy)
        assert same(live, fleet.folded(MADE))
        assert writer.run(lambda store: store.version.fact) == 2
        reference = [(name, by_reference(fleet.sent(name), name, MADE)) for name in MACHINES]
        assert plain(of_grid(live)) == plain(by_definition(reference, SITE.cell_m, CONFIG.fold))
    writer.close()
    for path in tmp_path.glob("snapshot-*"):
        path.unlink()
    with closing(open_store(tmp_path)) as store:
        assert same(store.grid, live)
        assert store.fact == 2


def test_a_correction_of_a_machine_that_is_left_out_folds_nothing_and_counts_when_it_comes_back(writer):
    fleet = Fleet(8)
    fleet.send(writer, 12)
    with closing(Refolding(writer, past_of(writer))) as refolds:
        refolds.wait(refolds.decide(TrustDecision("b", False, PERSON, "why", NOW_NS)), WAIT_S)
        grid = writer.run(lambda store: store.grid)
        refolds.wait(refolds.decide(decision("b")), WAIT_S)
        assert writer.run(lambda store: store.grid) is grid
        assert writer.run(lambda store: store.fact) == 2
        refolds.wait(refolds.decide(TrustDecision("b", True, PERSON, "mended", NOW_NS)), WAIT_S)
        assert same(writer.run(grid_copy), fleet.folded(decision("b").corrections))


def test_maps_of_the_past_have_the_facts_of_now_and_a_checkpoint_that_lacks_them_is_not_used(writer):
    fleet, past = Fleet(9), past_of(writer)
    for name in MACHINES:
        fleet.rows[name]["stamp_ns"] += np.arange(900) // 300 * HOUR_NS
    fleet.send(writer, 30)
    later = tuple(replace(one, from_ns=one.from_ns and one.from_ns + HOUR_NS) for one in MADE[1:])
    later = tuple(replace(one, to_ns=max(one.to_ns, one.from_ns + HOUR_NS)) for one in later)
    with closing(Refolding(writer, past)) as refolds, SqliteReader(writer.location.folder / JOURNAL_FILE) as reader:
        for hour in (1, 2, 3):
            assert list(make(past, reader, NOW_NS + hour * HOUR_NS, writer.run(lambda store: store.facts)))
        for name in "ab":
            refolds.wait(refolds.decide(decision(name, later)), WAIT_S)
        facts = writer.run(lambda store: store.facts)
        entries = past.checkpoints.entries(past.depends_on(reader, facts), reader.last_row)
        assert [entry.usable for entry in entries] == [True, False, False], "an hour that they do not touch stays"
        for hours in (0.4, 1.0, 1.3, 2.2, 5.0):
            to_ns = NOW_NS + round(hours * HOUR_NS)
            assert same(past.grid_as_of(reader, to_ns, facts=facts), fleet.folded(later, to_ns))
        assert same(writer.run(grid_copy), fleet.folded(later))
        assert list(make(past, reader, NOW_NS + 2 * HOUR_NS, facts))
        assert same(
            past.grid_as_of(reader, NOW_NS + 2 * HOUR_NS, facts=facts), fleet.folded(later, NOW_NS + 2 * HOUR_NS)
        )


def test_the_history_of_a_cell_is_that_of_corrected_samples(writer):
    rows = samples(200, stamp_ns=NOW_NS + np.arange(200) * 10 * S, c_rr=0.04, speed_mps=1.0, grade_e=0.0, grade_n=0.0)
    send(writer, [incoming(rows)])
    past = past_of(writer)
    facts = Facts(corrections=Corrections([Correction("a", NOW_NS + 1000 * S, END_NS, -0.2, 0.0, 0.0, ())]))
    with SqliteReader(writer.location.folder / JOURNAL_FILE) as reader:
        there, before = (cell_history(past, reader, (8, 8), 500 * S, Selection.by(each)) for each in (facts, Facts()))
        assert len(there.first_ns) == len(before.first_ns) >= 4
        differs = (there.evidence.counts != before.evidence.counts).any(axis=(1, 2))
        assert differs.tolist() == [first >= NOW_NS + 900 * S for first in there.first_ns.tolist()]


def test_a_snapshot_that_lacks_a_fact_is_folded_again(tmp_path):
    fleet = Fleet(11)
    with closing(open_writer(tmp_path)) as writer:
        fleet.send(writer, 15)
    files = tmp_path.glob("snapshot-*")  # a slow machine may have made one before
    old = max(files, key=lambda path: int(path.stem.removeprefix("snapshot-")))
    assert snapshot.load(old, SITE.cell_m, CONFIG.fold, Facts().of_evidence())
    with closing(open_store(tmp_path)) as store:
        store.decide(decision("a"))
        assert store.fact == 0, "killed before the map was folded again"
    with closing(open_store(tmp_path)) as store:
        assert same(store.grid, fleet.folded(decision("a").corrections))
        assert (store.snapshot_row, store.fact) == (0, 1)
        store.save_snapshot()
    with closing(open_store(tmp_path)) as store:
        assert store.snapshot_row == store.merged, "the new one has it"
        assert same(store.grid, fleet.folded(decision("a").corrections))


def looked(log: ChangeLog, grid: Grid) -> list[object]:
    """What a search for changes finds in all that was folded since the last look."""
    blocks = grid.take_touched(10_000)
    wide = sorted({near for block in blocks for near in around(block, reach_blocks(SITE.cell_m, CONFIG.change))})
    pages = {block: pages for block, pages in zip(wide, grid.pages(wide), strict=True) if pages}
    return list(log.look(blocks, pages))


def passes(c_rr: float, hours: range, zero: float) -> Table:
    """Many passes over a field of 24 by 24 cells, by a machine whose zero is off."""
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
    zero = 0.12  # so large that samples with and without it are of different classes
    log = ChangeLog(SITE.cell_m, CONFIG.change, CONFIG.read)
    gravel, paved = passes(0.2, range(4), zero), passes(0.02, range(5, 9), zero)
    send(writer, [incoming(gravel)])
    assert writer.run(lambda store: looked(log, store.grid)) == []
    with closing(Refolding(writer, past_of(writer))) as refolds:
        fact = CalibrationDecision("a", SOLVER, "", NOW_NS, (Correction("a", 0, END_NS, zero, 0.0, 0.0, ()),))
        refolds.wait(refolds.decide(fact), WAIT_S)
        assert writer.run(lambda store: looked(log, store.grid)) == [], "all was folded again, and nothing changed"
        send(writer, [incoming(paved[: len(paved) // 2], 1 + len(gravel))])
        refolds.wait(refolds.decide(replace(fact, corrections=(replace(fact.corrections[0], zero=0.119),))), WAIT_S)
        send(writer, [incoming(paved[len(paved) // 2 :], 1 + len(gravel) + len(paved) // 2)])
        found_changes = writer.run(lambda store: looked(log, store.grid))
    assert found_changes
    assert found_changes[-1].resistance_before == pytest.approx(0.2, rel=0.15)
    assert found_changes[-1].resistance_after == pytest.approx(0.02, rel=0.3)
    assert found_changes[-1].cells > 400
