"""Roads and worklists as they are answered: now and as of any time, by what the map is made of."""

from contextlib import closing

import numpy as np
import pytest

from mapserver.fleet.correction import Correction, Corrections
from mapserver.journal.facts import Facts
from protocol.errors import QueryError, Refusal
from protocol.queries.requests import MAX_LIMIT, SegmentsQuery, WorklistQuery, encode_query, parse_query
from protocol.queries.roads import decode_segments, decode_worklist
from protocol.site.geometry import Bounds
from tests.unit.mapserver.data import incoming, open_writer, send
from tests.unit.mapserver.query.fake_upkeep import answered, answers_of
from tests.unit.mapserver.roads.drives import START_NS, along, passes

HOUR_NS = 3600 * 10**9
LINE, BESIDE = along([(10, 10), (210, 10)]), along([(10, 100), (210, 160)])
FOREVER = 2**61


def rows_of(first: float = 0.05, second: float = 0.03):
    """Two machines, each on a road of its own; the second one an hour later."""
    return {"a": passes(LINE, 6, first), "b": passes(BESIDE, 6, second, seed=1, after_s=3600.0)}


@pytest.fixture
def writer(tmp_path):
    with closing(open_writer(tmp_path)) as opened:
        for machine, rows in rows_of().items():
            send(opened, [incoming(rows, machine=machine)])
        yield opened


def segments(answers, **parameters):
    return decode_segments(answered(answers, "segments", encode_query(SegmentsQuery(**parameters))))


def worklist(answers, **parameters):
    return decode_worklist(answered(answers, "worklist", encode_query(WorklistQuery(**parameters))))


def test_an_empty_map_has_an_empty_list(tmp_path):
    with closing(open_writer(tmp_path)) as opened:
        answers = answers_of(opened)
        assert segments(answers).segments == ()
        assert worklist(answers).rows == ()
        assert worklist(answers).total_kwh_ph == 0.0


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


def test_what_comes_in_shows_at_once_and_as_after_a_restart(writer, tmp_path):
    answers = answers_of(writer)
    segments(answers)
    more = passes(LINE, 4, 0.08, seed=2, after_s=7200.0)
    send(writer, [incoming(more, 1, machine="c")])
    assert worklist(answers) == worklist(answers_of(writer))
    assert segments(answers) == segments(answers_of(writer))
    assert worklist(answers).rows[0].segment.resistance > 0.055


def test_the_list_as_of_a_time_is_that_of_then(writer):
    answers = answers_of(writer)
    then_ns = int(rows_of()["a"]["stamp_ns"].max())
    before = worklist(answers, as_of_ns=then_ns)
    assert {row.segment.id.split("_")[1] for row in before.rows} == {"0"}
    newest = int(rows_of()["b"]["stamp_ns"].max())
    now, as_of_now = worklist(answers), worklist(answers, as_of_ns=newest)
    assert as_of_now.rows == now.rows


def test_a_machine_that_is_distrusted_is_not_in_it(tmp_path):
    with closing(open_writer(tmp_path)) as opened:
        for machine, rows in rows_of().items():
            send(opened, [incoming(rows, machine=machine)])
        answers = answers_of(opened)
        assert worklist(answers).rows
        without = Facts(frozenset({"a"}), number=1)
        opened.run(lambda store: setattr(store, "facts", without))
        answer = segments(answers)
    gone = [one for one in answer.segments if one.id.split("_")[1] == "0"]
    assert gone  # of this grid, which was not folded again here
    assert all(sum(one.passes_ph) == 0 and one.resistance is None for one in gone)


def test_samples_are_corrected(tmp_path):
    taken = Correction("a", 0, FOREVER, 0.02, 0.0, 0.0, ())
    with closing(open_writer(tmp_path)) as opened:
        for machine, rows in rows_of().items():
            send(opened, [incoming(rows, machine=machine)])
        answers = answers_of(opened)
        raw = {one.id: one.resistance for one in segments(answers).segments}
        opened.run(lambda store: setattr(store, "facts", Facts(corrections=Corrections([taken]), number=1)))
        right = {one.id: one.resistance for one in segments(answers).segments}
    assert right["3_0_e"] == pytest.approx(raw["3_0_e"] - 0.02, abs=1e-4)
    assert all(right[name] == raw[name] for name in raw if name.split("_")[1] != "0")


@pytest.mark.parametrize(
    ("name", "parameters", "problem"),
    [
        ("worklist", {"target": "0"}, "`target`"),
        ("worklist", {"target": "-0.1"}, "`target`"),
        ("worklist", {"target": "nan"}, "`target`"),
        ("worklist", {"efficiency": "0"}, "`efficiency`"),
        ("worklist", {"efficiency": "1.5"}, "`efficiency`"),
        ("worklist", {"limit": "0"}, "`limit`"),
        ("worklist", {"limit": str(MAX_LIMIT + 1)}, "`limit`"),
        ("worklist", {"machine": "a"}, "`machine` is not known"),
        ("segments", {"from": "20", "to": "10"}, "`from` .20. is after `to` .10."),
        ("segments", {"bounds": "1,2,3"}, "`bounds` must be"),
        ("segments", {"target": "0.02"}, "`target` is not known"),
    ],
)
def test_bad_parameters_are_refused_by_name(name, parameters, problem):
    with pytest.raises(QueryError, match=problem):
        parse_query(name, parameters)


def test_bounds_off_the_site_are_refused(writer):
    with pytest.raises(QueryError, match="off the site") as refused:
        segments(answers_of(writer), bounds=Bounds(1e6, 0, 2e6, 10))
    assert refused.value.reason == Refusal.OUT_OF_RANGE


@pytest.mark.parametrize(
    "query",
    [
        SegmentsQuery(),
        SegmentsQuery(5, 7, 9, Bounds(-1, -2, 3, 4)),
        WorklistQuery(),
        WorklistQuery(0.03, 0.4, 7, 5, 7, 9, Bounds(-1, -2, 3, 4)),
    ],
)
def test_queries_survive_the_wire(query):
    assert parse_query(query.name, encode_query(query)) == query


def test_traffic_of_one_stamp_is_no_division_by_nothing(tmp_path):
    rows = passes(LINE, 1)
    rows["stamp_ns"] = START_NS
    with closing(open_writer(tmp_path)) as opened:
        send(opened, [incoming(rows)])
        answer = worklist(answers_of(opened))
    assert all(np.isfinite(row.kwh_ph).all() for row in answer.rows)


def test_a_repair_is_told_and_counts(tmp_path):
    bad = {name: passes(LINE, 4, 0.06, seed=i, after_s=30.0 * i) for i, name in enumerate("ab")}
    good = {name: passes(LINE, 2, 0.02, seed=i, after_s=600.0 + 30.0 * i) for i, name in enumerate("ab", 7)}
    with closing(open_writer(tmp_path)) as opened:
        for machine, rows in bad.items():
            send(opened, [incoming(rows, machine=machine)])
        answers = answers_of(opened)
        before = worklist(answers, target=0.03)
        assert before.rows
        assert before.changes == ()
        for machine, rows in good.items():
            send(opened, [incoming(rows, 1 + len(bad[machine]), machine=machine)])
        after = worklist(answers, target=0.03)
        then = worklist(answers, target=0.03, as_of_ns=int(max(rows["stamp_ns"].max() for rows in bad.values())))
    assert after.rows == ()
    assert {change.id for change in after.changes} == {row.segment.id for row in before.rows}
    for change in after.changes:
        assert (change.before, change.after) == (pytest.approx(0.06, rel=0.1), pytest.approx(0.02, rel=0.1))
        assert START_NS + 500 * 10**9 < change.first_ns < change.seen_ns
        assert change.saved_kwh_ph > 0
    assert then.changes == ()
    assert [row.segment.id for row in then.rows] == [row.segment.id for row in before.rows]


def test_more_segments_than_an_answer_holds_are_refused_with_what_to_do(writer, monkeypatch):
    monkeypatch.setattr("mapserver.query.roads.MOST_SEGMENTS", 10)
    with pytest.raises(QueryError, match="at most 10 are answered: ask for less with `bounds`") as refused:
        segments(answers_of(writer))
    assert refused.value.reason == Refusal.TOO_LARGE
    assert segments(answers_of(writer), bounds=Bounds(0, 0, 100, 50)).segments
