"""Roads and worklists as answered, now and as of any time, after each kind of change."""

import threading
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing

import numpy as np
import pytest

from mapserver.calibration.correction import Correction, SampleCorrections
from mapserver.journal.facts import Facts
from mapserver.journal.location import JournalLocation
from mapserver.query import road_maps
from mapserver.query.answering import Answers
from mapserver.query.road_maps import ASKED_S, FRESH_S, RoadMaps
from protocol.errors import QueryError, Refusal, StoreError
from protocol.queries.map_tiles import PLANES, TilesQuery
from protocol.queries.requests import PointQuery, RegionQuery, WhyQuery, parse_query
from protocol.queries.roads import MAX_LIMIT, SegmentsQuery, WorklistQuery, decode_segments, decode_worklist
from protocol.queries.route_requests import RouteQuery, WayQuery
from protocol.queries.routing import decode_answer
from protocol.site.geometry import Bounds
from sitegrid.answer_text import fuel_text
from tests.patience import PATIENCE_S
from tests.unit.mapserver.data import incoming, open_writer, refused, send
from tests.unit.mapserver.query.fake_upkeep import answered, answers_of, source_of
from tests.unit.mapserver.roads.drives import START_NS, along, passes

HOUR_NS = 3600 * 10**9
LINE, BESIDE = along([(10, 10), (210, 10)]), along([(10, 100), (210, 160)])
FOREVER = 2**61


def rows_of(first: float = 0.05, second: float = 0.03):
    """Two machines on separate roads, the second an hour later."""
    return {"a": passes(LINE, 6, first), "b": passes(BESIDE, 6, second, seed=1, after_s=3600.0)}


@pytest.fixture
def writer(tmp_path):
    with closing(open_writer(tmp_path)) as opened:
        deliver(opened, [rows_of()])
        yield opened


def deliver(writer, parts):
    sent = Counter()
    for rows in parts:
        for name, own in rows.items():
            send(writer, [incoming(own, 1 + sent[name], machine=name)])
            sent[name] += len(own)


def of_both(count, c_rr, after_s):
    """Passes of two machines on one road."""
    return {
        name: passes(LINE, count, c_rr, seed=7 * count + i, after_s=after_s + 30.0 * i) for i, name in enumerate("ab")
    }


def segments(answers, **parameters):
    return decode_segments(answered(answers, "segments", SegmentsQuery(**parameters).parameters()))


def worklist(answers, **parameters):
    return decode_worklist(answered(answers, "worklist", WorklistQuery(**parameters).parameters()))


def test_an_empty_map_has_an_empty_list_and_traffic_of_one_stamp_a_finite_one(tmp_path):
    with closing(open_writer(tmp_path)) as opened:
        answers = answers_of(opened)
        assert segments(answers).segments == ()
        assert worklist(answers).rows == ()
        assert worklist(answers).total_kwh_ph == 0.0
        rows = passes(LINE, 1)
        rows["stamp_ns"] = START_NS
        send(opened, [incoming(rows)])
        assert all(np.isfinite(row.kwh_ph).all() for row in worklist(answers).rows)


def test_segments_say_what_drove_on_them(writer):
    answer = segments(answers_of(writer))
    assert (answer.merged, answer.placed) == (2, 1.0)
    here = {one.id: one for one in answer.segments}
    one = here["3_0_e"]
    assert one.resistance == pytest.approx(0.05, rel=0.05)
    assert one.resistance_std < 0.01
    assert one.length_m == pytest.approx(25, abs=1)
    assert one.passes_ph[0] * answer.hours == pytest.approx(6.0, rel=0.06)
    assert one.passes_ph[1] == 0.0
    assert one.tonnes_ph[0] == pytest.approx(40 * one.passes_ph[0])
    assert (one.trend, one.guessed, one.machines) == (None, False, 1)


def test_the_worklist_begins_with_what_costs_most(writer):
    answer = worklist(answers_of(writer))
    assert answer.target == 0.02
    first, last = answer.rows[0], answer.rows[-1]
    assert first.segment.resistance == pytest.approx(0.05, rel=0.1)
    assert last.segment.resistance < 0.04
    assert first.rank == 1
    assert [row.rank for row in answer.rows] == sorted(row.rank for row in answer.rows)
    for row in answer.rows:
        for low_high in (row.kwh_ph, row.litres_ph, row.seconds_ph):
            value, low, high = low_high
            assert 0 < low < value < high
        assert row.litres_ph[0] == pytest.approx(row.kwh_ph[0] * 3.6 / 35.8 / 0.35)
    assert answer.total_kwh_ph == pytest.approx(sum(row.kwh_ph[0] for row in answer.rows), rel=0.01)
    assert worklist(answers_of(writer), efficiency=0.7).rows[0].litres_ph[0] == pytest.approx(first.litres_ph[0] / 2)
    assert len(worklist(answers_of(writer), limit=3).rows) == 3
    assert worklist(answers_of(writer), target=0.2).rows == ()


def test_hours_and_bounds_choose(writer):
    answers = answers_of(writer)
    early = [one.id for one in segments(answers, to_ns=START_NS).segments if sum(one.passes_ph)]
    late = [one.id for one in segments(answers, from_ns=START_NS + HOUR_NS).segments if sum(one.passes_ph)]
    assert early
    assert late
    assert not set(early) & set(late)
    low = segments(answers, bounds=Bounds(0, 0, 300, 50))
    assert {one.id for one in low.segments} == set(early)
    rows = worklist(answers, bounds=Bounds(0, 50, 300, 300))
    assert {row.segment.id for row in rows.rows} <= set(late)
    assert rows.total_kwh_ph < worklist(answers).total_kwh_ph


def test_shuffled_and_rebatched_samples_give_the_same_list(tmp_path):
    """Two machines on a shared, repaired road and on their own; any order of senders and pieces."""
    draw, parts, lists = np.random.default_rng(37), (of_both(4, 0.06, 0.0), of_both(3, 0.02, 900.0), rows_of()), []
    rows = {name: np.concatenate([part[name] for part in parts]) for name in "ab"}
    for shuffled in (False, True):
        with closing(open_writer(tmp_path / str(shuffled))) as opened:
            for name in sorted(rows, reverse=shuffled):
                own = rows[name][draw.permutation(len(rows[name]))] if shuffled else rows[name]
                step = 37 if shuffled else len(own)
                for at in range(0, len(own), step):
                    send(opened, [incoming(own[at : at + step], 1 + at, machine=name)])
            answers = answers_of(opened)
            answers.examine_roads()
            listed = worklist(answers)
            lists.append((segments(answers).segments, listed.rows, listed.changes, drive(answers).totals))
    assert lists[0] == lists[1]
    assert lists[0][2], "with changes"


def test_facts_count_for_samples(writer):
    answers = answers_of(writer)
    raw = {one.id: one.resistance for one in segments(answers).segments}
    taken = Correction("a", 0, FOREVER, 0.02, 0.0, 0.0, ())
    writer.run(lambda store: setattr(store, "facts", Facts(corrections=SampleCorrections([taken]), number=1)))
    right = {one.id: one.resistance for one in segments(answers).segments}
    assert right["3_0_e"] == pytest.approx(raw["3_0_e"] - 0.02, abs=1e-4)
    assert all(right[name] == raw[name] for name in raw if name.split("_")[1] != "0")
    writer.run(lambda store: setattr(store, "facts", Facts(frozenset({"a"}), number=2)))
    gone = [one for one in segments(answers).segments if one.id.split("_")[1] == "0"]
    assert gone  # of this grid, not folded again here
    assert all(sum(one.passes_ph) == 0 and one.resistance is None for one in gone)


@pytest.mark.parametrize(
    ("name", "parameters", "problem"),
    [
        ("worklist", {"target": "0"}, "`target`"),
        ("worklist", {"target": "nan"}, "`target`"),
        ("worklist", {"efficiency": "0"}, "`efficiency`"),
        ("worklist", {"efficiency": "1.5"}, "`efficiency`"),
        ("worklist", {"limit": "0"}, "`limit`"),
        ("worklist", {"limit": str(MAX_LIMIT + 1)}, "`limit`"),
        ("worklist", {"machine": "a%0Ab"}, "`machine` must be one line"),
        ("segments", {"from": "20", "to": "10"}, "`from` .20. is after `to` .10."),
    ],
)
def test_bad_parameters_are_refused_by_name(name, parameters, problem):
    with pytest.raises(QueryError, match=problem):
        parse_query(name, parameters)


def test_what_cannot_be_answered_is_refused_with_what_to_do(writer, monkeypatch):
    answers = answers_of(writer)
    with refused(Refusal.OUTSIDE_SITE, "off the site"):
        segments(answers, bounds=Bounds(1e6, 0, 2e6, 10))
    for ask in (segments, worklist):
        with refused(Refusal.UNKNOWN_MACHINE, "machine `truck-9` has sent nothing"):
            ask(answers, machine="truck-9")
    monkeypatch.setattr("mapserver.query.roads.MOST_SEGMENTS", 10)
    with refused(Refusal.TOO_LARGE, "at most 10 are answered: ask for less with `bounds`"):
        segments(answers)
    assert segments(answers, bounds=Bounds(0, 0, 100, 50)).segments


def test_a_repair_is_told_and_counts(tmp_path):
    bad, good = of_both(4, 0.06, 0.0), of_both(2, 0.02, 600.0)
    with closing(open_writer(tmp_path)) as opened:
        deliver(opened, [bad])
        answers = answers_of(opened)
        before = worklist(answers, target=0.03)
        assert before.rows
        assert before.changes == ()
        for machine, rows in good.items():
            send(opened, [incoming(rows, 1 + len(bad[machine]), machine=machine)])
        assert worklist(answers).changes == (), "not before it is journalled"
        answers.examine_roads()
        after, now = (worklist(answers, target=target) for target in (0.03, 0.01))
        then = worklist(answers, target=0.03, as_of_ns=int(max(rows["stamp_ns"].max() for rows in bad.values())))
    assert after.rows == ()
    assert {change.id for change in after.changes} == {row.segment.id for row in before.rows}
    for change in after.changes:
        assert (change.before, change.after) == (pytest.approx(0.06, rel=0.1), pytest.approx(0.02, rel=0.1))
        assert START_NS + 500 * 10**9 < change.first_ns < change.seen_ns
        assert change.saved_kwh_ph > 0
    assert then.changes == ()
    assert [row.segment.id for row in then.rows] == [row.segment.id for row in before.rows]
    for row in then.rows:
        assert row.since_ns == START_NS // HOUR_NS * HOUR_NS
        assert (row.before, row.saved_kwh_ph) == (None, None)
    changed = {change.id: change for change in now.changes}
    assert now.rows
    for row in now.rows:
        change = changed[row.segment.id]
        assert (row.since_ns, row.before, row.saved_kwh_ph) == (change.first_ns, change.before, change.saved_kwh_ph)


def shown(answers):
    """What the newest roads show of repairs."""
    answers.roads.reach(answers.source.run(lambda state: state.version.row))
    answers.roads.read()
    return answers.roads.repairs()


BOX = Bounds(36.0, 8.0, 44.0, 13.0)


@pytest.fixture
def repaired(tmp_path):
    """Ground of 0.06 until 600 s, then 0.02, driven by two machines; a stamp before the repair."""
    with closing(open_writer(tmp_path)) as opened:
        deliver(opened, [of_both(4, 0.06, 0.0), of_both(3, 0.02, 900.0)])
        yield opened, START_NS + 800 * 10**9


def resistance(answers, as_of_ns=None):
    return answers.region(RegionQuery(BOX, ("resistance",), as_of_ns=as_of_ns)).layers["resistance"]


def test_a_found_change_begins_a_new_age_of_its_cells(repaired):
    opened, then_ns = repaired
    answers = answers_of(opened)
    plain = resistance(answers)
    answers.examine_roads()
    since = resistance(answers)
    driven, again = np.isfinite(plain), np.isfinite(since)  # some only touched since: unknown
    assert again.sum() > driven.sum() / 2
    assert not (again & ~driven).any()
    assert plain[driven].max() > 0.03  # old and new samples mixed: too narrow a strip for a change of cells
    assert since[again] == pytest.approx(0.02, rel=0.2)
    np.testing.assert_array_equal(resistance(answers_of(opened)), since)  # as after a restart
    before = resistance(answers, then_ns)
    assert before[again] == pytest.approx(0.06, rel=0.2)
    newest = opened.run(lambda store: store.newest_ns)
    np.testing.assert_array_equal(resistance(answers, newest), since)
    point = answers.point(PointQuery(40.0, 10.0, ("resistance",)))
    assert point.values["resistance"] == pytest.approx(0.02, rel=0.2)
    assert (point.merged, point.version.fact) == (worklist(answers).merged, worklist(answers).fact)


def test_reasons_are_of_the_value_that_is_read(repaired):
    opened, then_ns = repaired
    answers = answers_of(opened)
    plain = answers.why(WhyQuery(40.0, 10.0))
    answers.examine_roads()
    now, then = (answers.why(WhyQuery(40.0, 10.0, as_of_ns=as_of_ns)) for as_of_ns in (None, then_ns))
    point = answers.point(PointQuery(40.0, 10.0, ("resistance", "visits")))
    assert {name: now.values[name] for name in point.values} == pytest.approx(point.values)
    assert (now.merged, now.fact) == (point.merged, point.version.fact)
    assert now.before["resistance"] == pytest.approx(0.06, rel=0.2)
    assert now.changed_ns > then_ns
    assert np.sum(now.resistance.votes) + np.sum(now.resistance.before) == pytest.approx(np.sum(plain.resistance.votes))
    assert (plain.changed_ns, plain.before["resistance"]) == (0, None)
    assert (then.changed_ns, then.values["resistance"]) == (0, pytest.approx(0.06, rel=0.2))


def drive(answers, line=((15.0, 10.0), (205.0, 10.0)), **more):
    return decode_answer(answered(answers, "route", RouteQuery(line, **more).parameters()))


def test_a_route_is_of_the_road_as_it_is_since_its_repair(repaired):
    opened, then_ns = repaired
    answers = answers_of(opened)
    plain = drive(answers)
    answers.examine_roads()
    since, then = drive(answers), drive(answers, as_of_ns=then_ns)
    assert since.steps.resistance == pytest.approx(0.02, rel=0.1)
    assert then.steps.resistance == pytest.approx(0.06, rel=0.1)
    assert since.totals.energy_j < 0.8 * plain.totals.energy_j
    assert since.version.row == worklist(answers).merged
    way = WayQuery((15.0, 10.0), (205.0, 10.0))
    cheapest = decode_answer(answered(answers, "way", way.parameters()))
    assert cheapest.totals.energy_j == pytest.approx(since.totals.energy_j, rel=0.05)


def test_tiles_show_a_repair_once_it_is_journalled_and_no_others_are_sent(repaired):
    opened, _ = repaired
    send(opened, [incoming(passes(along([(300, 300), (380, 300)]), 1), machine="c")])
    answers = answers_of(opened)
    first = answers.tiles(TilesQuery())
    answers.examine_roads()
    later = {(tile.x, tile.y): tile for tile in answers.tiles(TilesQuery(first.version)).tiles}
    before = {(tile.x, tile.y): tile for tile in first.tiles}
    row = 10, slice(36, 44)
    resistance = PLANES["resistance"].values()
    assert resistance[before[0, 0].unpacked()["resistance"]][row].max() > 0.03
    assert resistance[later[0, 0].unpacked()["resistance"]][row] == pytest.approx(0.02, rel=0.2)
    assert before.keys() - later.keys(), "the new row's are those of then"
    assert {tile.row for tile in later.values()} == {5}
    fresh = {(tile.x, tile.y): tile.planes for tile in answers_of(opened).tiles(TilesQuery()).tiles}
    assert fresh == {place: tile.planes for place, tile in (before | later).items()}


def come(opened, machine="c"):
    """One more pass on the second road: a newer map."""
    send(opened, [incoming(passes(BESIDE, 1, after_s=5000.0), machine=machine)])


DEAR = 1e9  # factor on making times


class Clock:
    """Steady seconds, set by the test; each look takes some."""

    def __init__(self, look_s: float = 0.0) -> None:
        self.now_s, self._look_s = 100.0, look_s

    def __call__(self) -> float:
        self.now_s += self._look_s
        return self.now_s


@pytest.mark.parametrize(("look_s", "old_s"), [(0.5, FRESH_S), (0.01, 1.0)], ids=["long", "soon made"])
def test_roads_are_those_of_the_last_seconds_and_say_which(repaired, look_s, old_s):
    opened, _ = repaired
    clock = Clock(look_s)
    roads = RoadMaps(source_of(opened), clock)
    first = roads.read()
    come(opened)
    clock.now_s += 0.5 * old_s
    assert roads.read() is first, "no older than they may be, and the version says which"
    clock.now_s += 0.5 * old_s
    second = roads.read()
    assert (first.version.row, second.version.row) == (4, 5)
    clock.now_s += 100 * FRESH_S
    assert roads.read() is second, "nothing came in since, however long ago"


def row_of(answers: Answers, query: SegmentsQuery) -> int:
    return decode_segments(answers.answer(query)).merged


@pytest.fixture
def slow(repaired, monkeypatch):
    """Answers whose newer, awaited roads are in the making until an event is set."""
    opened, _ = repaired
    answers, may_end, began = answers_of(opened), threading.Event(), threading.Event()
    assert row_of(answers, SegmentsQuery()) == 4
    whole = road_maps.network

    def slowly(skeleton):
        began.set()
        assert may_end.wait(PATIENCE_S)
        return whole(skeleton)

    monkeypatch.setattr(road_maps, "network", slowly)
    monkeypatch.setattr(road_maps, "CHEAP", DEAR)
    come(opened)
    with ThreadPoolExecutor(4) as pool:
        waiting = [pool.submit(row_of, answers, SegmentsQuery(after=5)) for _ in range(4)]
        assert began.wait(PATIENCE_S)
        yield answers, may_end, waiting
        may_end.set()


def test_roads_in_the_making_hold_up_nobody_and_who_waits_for_them_takes_them(slow, monkeypatch):
    answers, may_end, waiting = slow
    assert row_of(answers, SegmentsQuery()) == row_of(answers, SegmentsQuery()) == 4
    assert drive(answers).version.row == 5
    with monkeypatch.context() as patched:
        patched.setattr(road_maps, "FRESH_S", -1.0)  # stale at once
        patched.setattr(road_maps, "COSTLY", 0)
        assert answers.roads.repairs() is None
        assert answers.tiles(TilesQuery()).version.row == 5
    may_end.set()
    assert [one.result(PATIENCE_S) for one in waiting] == [5] * 4
    assert row_of(answers, SegmentsQuery()) == 5


def test_roads_are_made_beside_while_somebody_asks(repaired):
    opened, _ = repaired
    clock = Clock()
    roads = RoadMaps(source_of(opened), clock)
    roads.renew()
    assert roads.made == 0, "nobody has asked yet"
    roads.read()
    clock.now_s += ASKED_S
    come(opened)
    roads.renew()
    assert roads.made == 1, "nobody asked for long"
    assert (roads.read().version.row, roads.made) == (5, 2)
    come(opened, "d")
    roads.renew()
    assert (roads.made, roads.read().version.row, roads.made) == (3, 6, 3), "and now somebody does"


def test_roads_of_a_map_that_is_there_at_the_start_are_made_before_anybody_asks(repaired, tmp_path):
    roads = RoadMaps(source_of(repaired[0]))
    roads.begin()
    roads.renew()
    assert roads.made == 1
    with closing(open_writer(tmp_path / "empty")) as opened:
        empty = RoadMaps(source_of(opened))
        empty.begin()
        empty.renew()
        assert empty.made == 0, "nobody has asked yet"


def test_a_journal_that_fails_ends_no_making(repaired, monkeypatch):
    opened, _ = repaired
    failures, reader = iter("12"), JournalLocation.reader

    def fails(location):
        if next(failures, None):
            raise StoreError("journal", "the disk is gone")
        return reader(location)

    monkeypatch.setattr(JournalLocation, "reader", fails)
    roads = RoadMaps(source_of(opened))
    with pytest.raises(QueryError, match="the disk is gone"):
        roads.read()
    assert roads.renew() > 0.0
    assert not roads.made
    roads.renew()
    assert roads.made


@pytest.mark.parametrize(
    "facts",
    [
        Facts(
            corrections=SampleCorrections([Correction(name, 0, FOREVER, 0.02, 0.0, 0.0, ()) for name in "ab"]), number=1
        ),
        Facts(frozenset({"b"}), number=1),
    ],
    ids=["calibration", "distrust"],
)
def test_a_fact_between_two_passes_is_no_repair(tmp_path, facts):
    """Samples of the machines, or of b alone, are off by 0.02; the fact comes as they drive on."""
    off = {"a": 0.0 if facts.excluded else 0.02, "b": 0.02}
    parts = [of_both(4, 0.04, 0.0), of_both(4, 0.04, 600.0)]
    for name in "ab":
        for part in parts:
            part[name]["c_rr"] += off[name]
    with closing(open_writer(tmp_path)) as opened:
        deliver(opened, parts[:1])
        answers = answers_of(opened)
        answers.examine_roads()
        opened.run(lambda store: setattr(store, "facts", facts))
        assert shown(answers) is None
        first = {name: 1 + len(rows) for name, rows in parts[0].items()}
        send(opened, [incoming(rows, first[name], machine=name) for name, rows in parts[1].items()])
        assert shown(answers) is None
        listed = worklist(answers)
        known = {one.id: one.resistance for one in segments(answers).segments}
    assert listed.changes == ()
    assert all(row.before is None and row.saved_kwh_ph is None for row in listed.rows)
    assert known["3_0_e"] == pytest.approx(0.04, rel=0.05)


def test_days_of_a_row_are_its_history(tmp_path):
    day_ns = 24 * HOUR_NS
    days = [passes(LINE, 2, 0.04 + 0.002 * day, seed=day, after_s=86_400.0 * day) for day in range(4)]
    with closing(open_writer(tmp_path)) as opened:
        deliver(opened, [{"a": rows} for rows in days])
        row = worklist(answers_of(opened)).rows[0]
    assert row.day_ns == tuple((START_NS // day_ns + day) * day_ns for day in range(4))
    assert row.day_resistance == pytest.approx([0.04, 0.042, 0.044, 0.046], abs=5e-4)
    assert row.segment.trend == pytest.approx(0.002, rel=0.15)


def test_traffic_of_one_machine_on_the_roads_of_all(writer):
    answers = answers_of(writer)
    everything, alone = segments(answers), segments(answers, machine="a")
    assert [one.id for one in alone.segments] == [one.id for one in everything.segments]
    by_id = {one.id: one for one in everything.segments}
    driven = [one for one in alone.segments if sum(one.passes_ph)]
    assert {one.id.split("_")[1] for one in driven} == {"0"}
    assert all(one.resistance == by_id[one.id].resistance for one in driven)
    rows = worklist(answers, machine="b").rows
    assert rows
    assert not {row.segment.id for row in rows} & {one.id for one in driven}
    then_ns = int(rows_of()["a"]["stamp_ns"].max())
    assert worklist(answers, machine="b", as_of_ns=then_ns).rows == ()


@pytest.mark.slow
def test_burned_litres_stand_beside_predicted_ones_in_the_list_and_at_changes(tmp_path):
    """Equal prices: predictions are right for sections burning by their resistance, absent without fuel."""
    worse = np.concatenate([of_both(8, 0.02, 0.0)["a"], of_both(6, 0.06, 1800.0)["a"]])
    worse["fuel_l"] = 0.5 * 40_000 * 9.80665 * worse["c_rr"] / (0.4 * 35.8e6)
    with closing(open_writer(tmp_path)) as opened:
        deliver(opened, [{"a": worse, "b": rows_of()["b"]}])
        answers = answers_of(opened)
        answers.examine_roads()
        answer = worklist(answers)
    fuels = {row.segment.id: row.segment.fuel for row in answer.rows}
    burning = [fuel for fuel in fuels.values() if fuel]
    assert 0 < len(burning) < len(fuels)
    for fuel in burning:
        (burned, low, high), (predicted, least, most) = fuel.burned_ph, fuel.predicted_ph
        assert low < burned < high
        assert least <= predicted <= most
        assert predicted == pytest.approx(burned, rel=0.1)
        assert fuel.share == pytest.approx(1.0)
    total = sum(fuel.burned_ph[0] for fuel in burning) * answer.hours
    assert total == pytest.approx(worse["fuel_l"].sum(), rel=0.2)
    assert answer.changes[0].fuel == fuels[answer.changes[0].id]
    assert "burned" in fuel_text(burning[0])
