"""Repairs of roads in the journal: once, withdrawn with what they rest on, and read alike by whoever follows."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapserver.follower.follower import FollowerSource
from mapserver.ingest.decisions import Decisions
from mapserver.ingest.following import Following
from mapserver.ingest.writer import Writer
from mapserver.journal.archive import archive
from mapserver.journal.journal import FencedError
from mapserver.journal.location import JournalLocation
from mapserver.journal.rows import Event
from mapserver.query.answering import Answers
from mapserver.roads.repair_facts import DIGITS, KIND, NO_REPAIRS, RoadRepair, cells_of, places_of
from mapserver.trust.decisions import PERSON, TrustDecision
from mapserver.upkeep.refolding import Refolding
from mapserver.upkeep.road_repairs import RoadRepairs
from protocol.arrays import Floats32
from protocol.errors import StoreError
from protocol.queries.coverage import CoverageQuery
from protocol.queries.lanes import LanesQuery
from protocol.queries.map_tiles import TilesQuery
from protocol.queries.requests import PointsQuery, RegionQuery, WhyQuery
from protocol.queries.roads import SegmentsQuery, WorklistQuery
from protocol.queries.route_requests import RouteQuery, WayQuery
from protocol.site.geometry import Bounds
from tests.patience import PATIENCE_S
from tests.unit.mapserver.data import (
    CONFIG,
    NOW_NS,
    SITE,
    fold_of,
    incoming,
    now_ns,
    open_writer,
    past_of,
    same,
    send,
    store_at,
)
from tests.unit.mapserver.query.fake_upkeep import answers_of
from tests.unit.mapserver.roads.drives import START_NS, along, passes

LINE = along([(10, 10), (110, 10)])
BOX = Bounds(0.0, 0.0, 120.0, 20.0)
GONE = TrustDecision("b", False, PERSON, "drawn", NOW_NS)


class Site:
    """A store, its answers and what folds it again; each delivery is a spool of its own."""

    def __init__(self, folder: Path) -> None:
        self.folder, self._spool = folder, 0
        self._open()

    def _open(self) -> None:
        self.writer = open_writer(self.folder)
        self.refolding, self.answers = Refolding(self.writer, past_of(self.writer)), answers_of(self.writer)

    def drives(self, c_rr: float, after_s: float, count: int = 3, machines: str = "ab") -> None:
        for i, name in enumerate(machines):
            self._spool += 1
            rows = passes(LINE, count, c_rr, seed=self._spool, after_s=after_s + 30.0 * i)
            send(self.writer, [incoming(rows, machine=name, spool_id=self._spool)])

    def decides(self, decision: TrustDecision) -> None:
        self.refolding.wait(self.refolding.decide(decision), PATIENCE_S)

    def events(self) -> list[RoadRepair]:
        events = self.writer.run(lambda store: store.journal.events(KIND))
        return [RoadRepair.from_body(event.body) for event in events]

    def resistance(self, as_of_ns: int | None = None) -> Floats32:
        return self.answers.region(RegionQuery(BOX, ("resistance",), as_of_ns=as_of_ns)).layers["resistance"]

    def starts_again(self) -> None:
        self.close()
        self._open()

    def is_killed(self) -> None:
        """Go on with a copy of what is on disk now."""
        copy = self.folder.with_name(f"{self.folder.name}-killed")
        shutil.copytree(self.folder, copy)
        self.close()
        self.folder = copy
        self._open()

    def close(self) -> None:
        self.refolding.close()
        self.writer.close()


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    """Repaired after 600 s."""
    with closing(Site(tmp_path)) as opened:
        opened.drives(0.06, 0.0, 4)
        opened.drives(0.02, 900.0)
        yield opened


def test_a_repair_is_journalled_once_and_moves_no_grid(site: Site):
    grid, plain = site.writer.run(lambda store: store.grid), site.resistance()
    lanes = [tile.metres for tile in site.answers.lanes(LanesQuery()).tiles]
    site.answers.examine_roads()
    events, read = site.events(), site.resistance()
    assert len({event.segment for event in events}) == len(events) >= 3
    assert not np.array_equal(plain, read, equal_nan=True)
    np.testing.assert_array_equal([tile.metres for tile in site.answers.lanes(LanesQuery()).tiles], lanes)
    version = site.writer.run(lambda store: store.version)
    assert (version.row, version.fact) == (4, len(events))
    site.answers.examine_roads()
    assert answers_of(site.writer).roads.repairs() is None
    site.starts_again()
    site.answers.examine_roads()
    assert site.events() == events
    assert site.writer.run(lambda store: store.version) == version
    np.testing.assert_array_equal(site.resistance(), read)
    assert same(grid, site.writer.run(lambda store: fold_of(store.journal.read()))), "the same evidence throughout"
    assert site.writer.run(lambda store: store.snapshot_row) == 4, "a snapshot outlives repairs"


def test_a_repair_that_rested_on_a_machine_goes_with_it_and_returns_with_it(site: Site, tmp_path: Path):
    site.answers.examine_roads()
    shown, read = site.events(), site.resistance()
    site.decides(GONE)
    site.answers.examine_roads()
    assert [event.cells for event in site.events()[len(shown) :]] == [()] * len(shown)
    assert not site.writer.run(lambda store: store.facts.repairs.standing)
    with closing(Site(tmp_path / "alone")) as alone:
        send(alone.writer, [incoming(row.rows, machine="a", spool_id=row.row) for row in rows_of(site, "a")])
        np.testing.assert_array_equal(site.resistance(), alone.resistance())
    site.decides(replace(GONE, trusted=True))
    site.answers.examine_roads()
    np.testing.assert_array_equal(site.resistance(), read)
    assert {event.key for event in site.events()} == {event.key for event in shown}


def rows_of(site: Site, machine: str):
    return site.writer.run(lambda store: [row for row in store.journal.read() if row.machine == machine])


def test_samples_of_before_the_repair_that_come_late_do_not_count(site: Site):
    site.answers.examine_roads()
    ages = site.writer.run(lambda store: store.facts.repairs.ages)
    aged = np.concatenate([places_of(event.cells) for event in site.events()])
    read = site.resistance()[aged[:, 1], aged[:, 0]]
    site.drives(0.09, 0.0, 4)
    np.testing.assert_array_equal(site.resistance()[aged[:, 1], aged[:, 0]], read)
    site.answers.examine_roads()
    now = site.writer.run(lambda store: store.facts.repairs.ages)
    assert now.keys() == ages.keys()
    assert all((now[block] >= ages[block]).all() for block in ages)


def test_a_decision_in_between_lets_nothing_be_written_that_was_found_before(site: Site):
    site.answers.roads.read()
    job = RoadRepairs(site.writer, site.answers.roads.repairs)
    shown = site.answers.roads.repairs()
    assert shown
    stale = RoadRepairs(site.writer, lambda: shown)
    site.decides(GONE)
    stale.run()
    assert site.events() == []
    job.run()
    assert site.events() == [], "nothing new"


def test_a_write_that_fails_is_done_again(site: Site, monkeypatch: pytest.MonkeyPatch):
    site.answers.roads.read()
    job = RoadRepairs(site.writer, site.answers.roads.repairs)
    with monkeypatch.context() as patched:
        patched.setattr("mapserver.ingest.store.Store.repair", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            job.run()
    job.run()
    assert site.events()


@pytest.mark.slow
def test_of_two_servers_in_a_take_over_one_journals_it(tmp_path: Path, database):
    locations = [JournalLocation(tmp_path / name, database.url) for name in ("one", "two")]
    with closing(Writer(store_at(locations[0]))) as first:
        for spool, (c_rr, after_s, count) in enumerate(((0.06, 0.0, 4), (0.02, 900.0, 3))):
            for i, name in enumerate("ab"):
                rows = passes(LINE, count, c_rr, seed=2 * spool + i, after_s=after_s + 30.0 * i)
                send(first, [incoming(rows, machine=name, spool_id=1 + spool)])
        shown = answers_of(first).roads.repairs()
        assert shown
        first.run(lambda store: store.journal._close_sessions())  # it hangs, and its lock is gone
        with closing(Writer(store_at(locations[1]))) as second:
            answers_of(second).examine_roads()
            events = second.run(lambda store: [event.body for event in store.journal.events(KIND)])
            assert len(events) == len(shown[1])
            RoadRepairs(first, lambda: shown).run()  # it hears of them first
            with pytest.raises(FencedError):
                first.run(lambda store: store.decide(*shown[1]))
            answers_of(second).examine_roads()
            assert second.run(lambda store: [event.body for event in store.journal.events(KIND)]) == events


# --- everybody reads alike -------------------------------------------------------------------------------------------

LAYERS = ("resistance", "resistance_filled", "visits", "changed_s", "weight")
ENDS = ((12.0, 10.0), (108.0, 10.0))
QUESTIONS = (
    PointsQuery(((40.5, 10.5), (80.5, 9.5)), LAYERS),
    RegionQuery(BOX, LAYERS),
    RegionQuery(BOX, ("resistance",), resolution_m=4.0),
    TilesQuery(),
    WhyQuery(40.5, 10.5),
    CoverageQuery(),
    LanesQuery(),
    SegmentsQuery(),
    WorklistQuery(),
    RouteQuery(ENDS),
    WayQuery(*ENDS),
)
WHAT = st.sampled_from(["nothing more", "decides", "archives", "starts again", "is killed", "examines"])
COURSE = st.lists(st.tuples(WHAT, st.sampled_from([0.02, 0.06]), st.booleans()), min_size=1, max_size=6)


def does(site: Site, what: str) -> None:
    match what:
        case "decides":
            excluded = site.writer.run(lambda store: store.facts.excluded)
            site.decides(replace(GONE, trusted="b" in excluded))
        case "archives":
            location = JournalLocation(site.folder)
            with location.reader() as reader:
                forget = lambda until: site.writer.run(lambda store: store.journal.forget(until))  # noqa: E731
                list(archive(location.archive.folder, reader, SITE, NOW_NS + 10**15, forget, NOW_NS))
        case "starts again":
            site.starts_again()
        case "is killed":
            site.is_killed()
        case "examines":
            site.answers.examine_roads()


def follower_of(folder: Path) -> Answers:
    following = Following(JournalLocation(folder), SITE, CONFIG)
    following.read_once()
    return Answers(FollowerSource("f", following, now_ns))


@pytest.mark.slow
@settings(max_examples=5, deadline=None)
@given(COURSE, st.booleans())
def test_server_follower_killed_server_and_as_of_now_answer_alike(tmp_path_factory, course, ends_examined):
    folder = tmp_path_factory.mktemp("store")
    with closing(Site(folder)) as site:
        site.drives(0.06, 0.0, 4)
        for turn, (what, c_rr, late) in enumerate([("examines", 0.02, False), *course]):
            site.drives(c_rr, 900.0 * (0 if late else 1 + turn))
            does(site, what)
        if ends_examined:
            site.answers.examine_roads()
        site.answers.roads.reach(site.writer.run(lambda store: store.merged))
        answers = [site.answers.answer(query) for query in QUESTIONS]
        assert answers == [follower_of(site.folder).answer(query) for query in QUESTIONS]
        standing = site.writer.run(lambda store: store.facts.repairs.standing)
        site.is_killed()
        site.answers.roads.reach(1)
        assert answers == [site.answers.answer(query) for query in QUESTIONS]
        assert site.writer.run(lambda store: store.facts.repairs.standing) == standing
        site.answers.examine_roads()
        newest_ns = site.writer.run(lambda store: store.newest_ns)
        np.testing.assert_array_equal(site.resistance(newest_ns), site.resistance())


# --- events ----------------------------------------------------------------------------------------------------------

REPAIR = RoadRepair("3_0_e", START_NS, START_NS + 1, START_NS + 2, 0.06, 0.02, 1.0, ((1, -2, "0f" * 32),), START_NS + 3)


def hear(body: object) -> Decisions:
    decisions = Decisions(1.0)
    decisions.hear([Event(1, KIND, 1, body)], "the journal")  # type: ignore[arg-type]
    return decisions


def test_an_event_is_read_as_it_was_written_and_withdrawn_by_its_key():
    assert RoadRepair.from_body(json.loads(json.dumps(REPAIR.body()))) == REPAIR
    column, row = np.array([[16, 31, -1], [-32, -17, 5]])
    cells = cells_of(column, row)
    assert sorted(map(tuple, places_of(cells).tolist())) == sorted(zip(column.tolist(), row.tolist(), strict=True))
    stands = hear(REPAIR.body()).facts
    assert stands.repairs.ages[1, -2].tolist() == [0, 0, 0, 0, *[REPAIR.first_ns] * 4] * 32
    assert stands == Decisions().facts, "grids do not depend on it"
    assert stands.repairs.ages_as_of(REPAIR.seen_ns - 1, [(1, -2)]) == {}
    assert stands.repairs.ages_as_of(REPAIR.seen_ns, [(1, -2)]).keys() == {(1, -2)}
    gone = stands.repairs.after([replace(REPAIR, cells=())])
    assert (gone.standing, gone.ages) == ({}, {})
    assert gone.differing(stands.repairs) == {(1, -2)}
    assert not hear({**REPAIR.body(), "cell_m": 0.5}).facts.repairs.standing, "on cells of another size"


def test_a_repair_whose_passes_are_forgotten_stands_and_one_that_moved_a_little_is_the_same():
    moved = replace(
        REPAIR, segment="3_0_e.1", first_ns=REPAIR.first_ns + 10**9, cells=((1, -2, "0f" * 20 + "00" * 12),)
    )
    stands = NO_REPAIRS.after([REPAIR])
    assert stands.judged([moved], set(), 0, REPAIR.stamp_ns) == []
    assert stands.judged([], set(), REPAIR.known_ns + 1, REPAIR.stamp_ns) == []
    assert stands.judged([], set(), REPAIR.known_ns, REPAIR.stamp_ns) == [replace(REPAIR, cells=())]
    assert stands.judged([], {REPAIR.key}, REPAIR.known_ns, REPAIR.stamp_ns) == []
    far = replace(moved, cells=((1, -3, "0f" * 32),))
    assert stands.judged([far], set(), 0, REPAIR.stamp_ns) == [replace(REPAIR, cells=()), far]


@pytest.mark.parametrize(
    "wrong",
    [
        {"segment": "nowhere"},
        {"segment": 3},
        {"known_ns": REPAIR.first_ns + 1},
        {"first_ns": -1},
        {"first_ns": 1.0},
        {"seen_ns": 2**63},
        {"seen_ns": True},
        {"stamp_ns": 0},
        {"before": float("nan")},
        {"after": 2.0},
        {"after": "0.02"},
        {"cells": [[1, 2, "0f"]]},
        {"cells": [[1, 2, "zz" * 32]]},
        {"cells": [[1, 2, "0f " * 21 + "0"]]},
        {"cells": [[1.5, 2, "0f" * 32]]},
        {"cells": [[1, 2, "0f" * 32]] * 2},
        {"cells": [[2**31, 2, "0f" * 32]]},
        {"cells": [["a", 2, "0f" * 32]]},
        {"cells": 7},
        {"cell_m": 0.0},
        {"cell_m": "1"},
        {"colour": "red"},
    ],
)
def test_an_event_of_no_road_is_refused_by_name(wrong):
    with pytest.raises(StoreError, match=r"event 1 is of another program \(.*\); open the store with that one"):
        hear({**REPAIR.body(), **wrong})


plain = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=DIGITS),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=8,
)


@given(
    st.dictionaries(st.sampled_from([*REPAIR.body(), "more"]), plain, max_size=3),
    st.sets(st.sampled_from([*REPAIR.body()])),
)
def test_a_fuzzed_event_is_refused_or_read_as_it_is(edits, missing):
    body = {name: value for name, value in {**REPAIR.body(), **edits}.items() if name not in missing or name in edits}
    try:
        (repair,) = hear(body).facts.repairs.standing.values() or [RoadRepair.from_body(body)]
    except StoreError:
        return
    assert json.dumps(repair.body()) == json.dumps({name: body[name] for name in repair.body()})
