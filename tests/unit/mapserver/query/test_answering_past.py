"""Maps as of any time, differences, point histories; machines, changes, commands."""

from contextlib import closing
from unittest.mock import Mock

import numpy as np
import pytest

from mapserver.journal.facts import Facts
from mapserver.journal.journal import FencedError, UnwrittenError
from mapserver.journal.location import JournalLocation
from mapserver.layers.cell_layers import LAYERS
from mapserver.past.past import StorePast
from mapserver.query.answering import Answers
from mapserver.query.server_source import CommandDesk
from protocol.errors import QueryError, Refusal
from protocol.queries import answer_codec as codec
from protocol.queries.commands import TrustCommand
from protocol.queries.coverage import CoverageQuery
from protocol.queries.map_tiles import TilesQuery
from protocol.queries.origin import SERVER
from protocol.queries.requests import MAX_SPANS, HistoryQuery, PointQuery, PointsQuery, RegionQuery
from protocol.site.geometry import Bounds
from sitegrid.follower_choice import Answered
from sitegrid.whole_answers import whole_answer
from tests.unit.mapserver.data import NOW_NS, incoming, open_writer, random_samples, refused, samples, send
from tests.unit.mapserver.query.fake_upkeep import FakeUpkeep, answered, answers_of

S, HOUR_NS = 10**9, 3600 * 10**9
BOX = Bounds(-40, -40, 40, 40)
ROWS = {"a": random_samples(600, 5, std_m=1.0), "b": random_samples(600, 6, std_m=1.0)}
ROWS["b"]["stamp_ns"] += HOUR_NS
NEWEST_NS = int(ROWS["b"]["stamp_ns"].max())
NAMES = (*LAYERS, "resistance_filled", "grade_filled_std")


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    """Start a writer with each machine's samples in two rows, in its own folder."""
    opened = []

    def start(rows=None, upkeep=None, excluded=()) -> Answers:
        writer = open_writer(tmp_path_factory.mktemp("store"))
        opened.append(writer)
        for machine, table in (ROWS if rows is None else rows).items():
            half = len(table) // 2
            send(writer, [incoming(part, machine=machine) for part in (table[:half],) if len(part)])
            send(writer, [incoming(table[half:], 1 + half, machine)])
        writer.run(lambda store: setattr(store, "facts", Facts(frozenset(excluded))))
        return answers_of(writer, upkeep)

    yield start
    for writer in opened:
        writer.close()


@pytest.fixture(scope="module")
def answers(served):
    return served()


def until(rows, stamp_ns: int):
    return {name: part for name, table in rows.items() if len(part := table[table["stamp_ns"] <= stamp_ns])}


def equal(one, other, names=NAMES) -> bool:
    return all(np.array_equal(one[name], other[name], equal_nan=True) for name in names)


def test_the_map_as_of_now_is_the_map_to_the_bit(answers):
    here = answers.region(RegionQuery(BOX, NAMES))
    then = answers.region(RegionQuery(BOX, NAMES, as_of_ns=NEWEST_NS))
    assert equal(here, then)
    assert np.isfinite(here["resistance"]).any()
    assert (then.merged, then.stamp_ns, then.bounds) == (4, NEWEST_NS, here.bounds)


@pytest.mark.parametrize(("after_s", "bounds"), [(900, (-3, 5, 12, 9)), (3600 + 900, (-40, -40, 40, 40))])
def test_the_map_as_of_a_time_is_that_of_a_server_that_knew_no_more(answers, served, after_s, bounds):
    stamp_ns = NOW_NS + after_s * S  # amid journal rows
    then = answers.region(RegionQuery(Bounds(*bounds), NAMES, as_of_ns=stamp_ns))
    known = until(ROWS, stamp_ns)
    only = served(known).region(RegionQuery(Bounds(*bounds), NAMES))
    # Ages count from the time asked for, not from the last sample before it.
    assert equal(then, only, [name for name in NAMES if name not in ("age_s", "changed_s")])
    late_s = (stamp_ns - max(int(table["stamp_ns"].max()) for table in known.values())) / S
    np.testing.assert_allclose(then["age_s"], only["age_s"] + late_s, atol=0.01)
    assert np.isfinite(then["age_s"]).any()
    assert then.stamp_ns == stamp_ns


def test_a_past_map_is_folded_in_parts_and_is_the_same(answers, monkeypatch):
    stamp_ns, read = NOW_NS + 900 * S, list[int]()
    names = tuple(name for name in NAMES if name != "heading")
    whole = RegionQuery(BOX, names, as_of_ns=stamp_ns, minus_ns=NOW_NS + 300 * S)
    coarse = RegionQuery(BOX, ("resistance", "resistance_filled"), resolution_m=3.0, as_of_ns=stamp_ns)
    places = tuple((x + 0.5, 7.0 * x % 40 - 20.5) for x in range(-90, 90, 5))
    points = PointsQuery(places, names, as_of_ns=stamp_ns, minus_ns=NOW_NS + 300 * S)
    queries = (whole, coarse, points, TilesQuery(as_of_ns=stamp_ns), CoverageQuery(as_of_ns=stamp_ns))

    def asked() -> list[object]:
        first = [whole_answer(query, lambda one, _: Answered(answers.answer(one), SERVER)) for query in queries]
        layers = [{name: values.tobytes() for name, values in one.layers.items()} for one in first[:3]]
        return [*layers, first[3].tiles, first[4]]

    grid_as_of = StorePast.grid_as_of

    def folded(self, reader, to_ns, window, *more):
        read.append(window.columns * window.rows)
        return grid_as_of(self, reader, to_ns, window, *more)

    monkeypatch.setattr(StorePast, "grid_as_of", folded)
    at_once, most = asked(), max(read)
    monkeypatch.setattr("mapserver.query.views.PART_BYTES", 1)
    monkeypatch.setattr("mapserver.query.region_pieces.PIECE_BYTES", 16 * 16 * len(NAMES) * 4)
    monkeypatch.setattr("mapserver.query.region_pieces.MEAN_CELLS", 100)
    read.clear()
    assert asked() == at_once
    assert max(read) < 0.6 * most
    assert len(read) > 20


def repaved():
    """20 x 20 m driven at 0.02, two hours later at 0.25."""
    x, y = (axis.ravel() + 0.5 for axis in np.meshgrid(np.arange(20), np.arange(20)))
    place = {"x_m": x, "y_m": y, "distance_m": 4.0}
    old = samples(400, **place, c_rr=0.02, stamp_ns=NOW_NS + np.arange(400))
    new = samples(400, **place, c_rr=0.25, stamp_ns=NOW_NS + 2 * HOUR_NS + np.arange(400))
    return {"a": np.concatenate([old, new])}


def test_what_changed_later_has_not_changed_yet(served):
    answers = served(repaved())
    names = ("resistance", "changed_s", "resistance_class")
    stamps = (NOW_NS + HOUR_NS, NOW_NS + 3 * HOUR_NS)
    before, after = (answers.point(PointQuery(10.0, 10.0, names, as_of_ns=t)).values for t in stamps)
    assert before["resistance"] == pytest.approx(0.02, rel=0.05)
    assert np.isnan(before["changed_s"])
    assert after["resistance"] == pytest.approx(0.25, rel=0.05)
    assert after["changed_s"] == pytest.approx(3600, abs=301)
    now = answers.point(PointQuery(10.0, 10.0, names)).values
    assert now["resistance"] == after["resistance"]


def test_a_difference_is_value_by_value_and_unknown_where_either_is(answers):
    names = ("resistance", "visits", "resistance_filled")
    middle_ns = NOW_NS + 900 * S
    newer = answers.region(RegionQuery(BOX, names))
    older = answers.region(RegionQuery(BOX, names, as_of_ns=middle_ns))
    both = answers.region(RegionQuery(BOX, names, minus_ns=middle_ns))
    for name in names:
        assert np.array_equal(both[name], newer[name] - older[name], equal_nan=True)
        assert (np.isnan(both[name]) == (np.isnan(newer[name]) | np.isnan(older[name]))).all()
    assert (both.merged, both.stamp_ns) == (4, NEWEST_NS)


def test_a_difference_of_two_pasts_is_as_of_the_newer(served):
    answers = served(repaved())
    early, late = NOW_NS + HOUR_NS, NOW_NS + 3 * HOUR_NS
    names = ("resistance", "resistance_class")
    point = answers.point(PointQuery(10.0, 10.0, names, as_of_ns=late, minus_ns=early))
    assert point.values["resistance"] == pytest.approx(0.23, rel=0.05)
    assert point.values["resistance_class"] == 3.0  # from class 1 to 4: number of classes
    assert point.stamp_ns == late
    back = answers.point(PointQuery(10.0, 10.0, names, as_of_ns=early, minus_ns=late))
    assert back.values["resistance_class"] == -3.0


def test_axes_have_no_difference(answers):
    with refused(Refusal.OUT_OF_RANGE, "`heading` has no difference; ask for it without `minus`"):
        answers.point(PointQuery(0.0, 0.0, ("visits", "heading"), minus_ns=NOW_NS))
    values = answers.point(PointQuery(0.0, 0.0, minus_ns=NOW_NS)).values
    assert set(values) == set(LAYERS) - {"heading"}


def hours(*rates: float):
    """A cell driven for the first two minutes of each hour."""
    parts = [
        samples(12, c_rr=c_rr, stamp_ns=NOW_NS + i * HOUR_NS + np.arange(12) * 10 * S) for i, c_rr in enumerate(rates)
    ]
    return {"a": np.concatenate(parts)}


def test_a_history_reads_each_span_alone(served):
    answers = served(hours(0.02, 0.05, 0.25))
    got = answers.history(HistoryQuery(8.2, 8.9, ("resistance", "age_s", "changed_s")))
    assert (got.x_m, got.y_m, got.merged) == (8.5, 8.5, 2)
    assert got.stamp_ns == NOW_NS + 2 * HOUR_NS + 110 * S
    assert [span.first_ns for span in got.spans] == [NOW_NS + i * HOUR_NS for i in range(3)]  # 300 s, others empty
    assert all(span.last_ns - span.first_ns == 300 * S - 1 for span in got.spans)
    values = [span.values["resistance"] for span in got.spans]
    assert values == pytest.approx([0.02, 0.05, 0.25], rel=0.02)
    assert [span.values["age_s"] for span in got.spans] == pytest.approx([190, 190, 190], abs=0.01)
    assert np.isnan([span.values["changed_s"] for span in got.spans]).all()


def test_a_history_is_bounded_by_its_times_and_cut_by_its_span(served):
    answers = served(hours(0.02, 0.05, 0.25))
    times = {"from_ns": NOW_NS + HOUR_NS, "to_ns": NOW_NS + 2 * HOUR_NS}
    got = answers.history(HistoryQuery(8.5, 8.5, ("weight",), **times))
    assert [span.first_ns for span in got.spans] == [NOW_NS + HOUR_NS, NOW_NS + 2 * HOUR_NS]
    assert got.spans[0].values["weight"] > 5 * got.spans[1].values["weight"] > 0  # the first sample of that hour
    got = answers.history(HistoryQuery(8.5, 8.5, ("weight",), span_s=60.0))
    assert [(span.first_ns - NOW_NS) // S for span in got.spans] == [0, 60, 3600, 3660, 7200, 7260]
    [day] = answers.history(HistoryQuery(8.5, 8.5, span_s=86_400.0)).spans
    assert tuple(day.values) == tuple(LAYERS)
    assert answers.history(HistoryQuery(1000.0, 0.0)).spans == ()


def test_too_many_spans_are_refused_before_any_is_read(served, monkeypatch):
    answers = served(hours(0.02, 0.05))
    to_ns = NOW_NS + MAX_SPANS * 300 * S - 1
    assert len(answers.history(HistoryQuery(8.5, 8.5, ("weight",), NOW_NS, to_ns)).spans) == 2
    monkeypatch.setattr("mapserver.query.views.cell_history", None)
    with refused(Refusal.TOO_LARGE, r"2001 spans of 300 s; at most 2000 .* a longer `span`"):
        answers.history(HistoryQuery(8.5, 8.5, ("weight",), NOW_NS, to_ns + 1))


def test_without_a_first_time_the_newest_spans_are_answered(served):
    answers = served(hours(0.02, 0.05, 0.25))
    query = HistoryQuery(8.5, 8.5, ("weight",), span_s=1.0)  # 2000 s until now, 7310 s after the first sample
    spans = answers.history(query).spans
    assert {(span.first_ns - NOW_NS) // HOUR_NS for span in spans} == {2}
    before = answers.history(HistoryQuery(8.5, 8.5, ("weight",), to_ns=NOW_NS + HOUR_NS, span_s=2.0)).spans
    assert {(span.first_ns - NOW_NS) // HOUR_NS for span in before} == {0, 1}


def test_a_history_leaves_out_machines_and_filled_layers(served):
    rows = hours(0.02, 0.05)
    assert served(rows, excluded="a").history(HistoryQuery(8.5, 8.5)).spans == ()
    with refused(Refusal.UNKNOWN_LAYER, "`resistance_filled` is made from a cell's neighbours"):
        served(rows).history(HistoryQuery(8.5, 8.5, ("visits", "resistance_filled")))


def test_a_past_that_cannot_be_read_is_refused(tmp_path):
    with closing(open_writer(tmp_path)) as writer:
        writer.location = JournalLocation(tmp_path / "elsewhere")
        answers = answers_of(writer)
        for query in (PointQuery(0, 0, as_of_ns=1), HistoryQuery(0, 0)):
            with refused(Refusal.STORE, "no usable journal"):
                answers.answer(query)


def test_questions_about_the_past_are_recognised():
    assert HistoryQuery(0, 0).reads_past
    assert PointQuery(0, 0, as_of_ns=1).reads_past
    assert RegionQuery(BOX, minus_ns=1).reads_past
    assert not PointQuery(0, 0, after=3).reads_past


def test_the_upkeep_is_asked(served):
    upkeep = FakeUpkeep()
    answers = served(upkeep=upkeep)
    commands = CommandDesk(answers.writer, upkeep, answers.info)  # type: ignore[arg-type]
    machines = codec.decode_machines(answered(answers, "machines", {"after": "1"})).machines
    assert [(machine.name, machine.trusted) for machine in machines] == [("a", True), ("b", False)]
    changes = codec.decode_changes(answered(answers, "changes", {"after": "41"})).changes
    assert [change.id for change in changes] == [42]
    row = codec.decode_machine(commands.obey("trust", TrustCommand("b", False, "drifts; x=1", 5.0).parameters()))
    assert (row.name, row.trusted, row.merged) == ("b", False, 4)
    commands.obey("trust", {"machine": "b", "trusted": "auto"})
    assert upkeep.asked == [41, ("b", False, "drifts; x=1", 5.0), ("b", None, "", 30.0)]
    with refused(Refusal.UNKNOWN_MACHINE, "`c` is not known"):
        commands.obey("trust", {"machine": "c", "trusted": "yes"})
    with pytest.raises(QueryError, match="row 9 is not merged"):
        answered(answers, "machines", {"after": "9", "wait": "0.01"})


@pytest.mark.parametrize(
    ("error", "reason", "problem"),
    [
        (UnwrittenError("here", "the disk is full"), Refusal.STORE, "does not count: the disk is full; make room"),
        (UnwrittenError("here", "it was cut", unsure=True), Refusal.AFTER_TIMEOUT, "not known whether .* it was cut"),
        (FencedError("here", "another one took over"), Refusal.NOT_WRITER, "is not written: another one took over"),
    ],
)
def test_an_accepted_store_that_is_not_written_is_refused_as_a_decision_is(tmp_path, error, reason, problem):
    with closing(open_writer(tmp_path)) as writer:
        writer._store.journal.append_event = Mock(side_effect=error)
        with refused(reason, problem):
            CommandDesk(writer, None, dict).obey("accept", {"store": "0123456789abcdef", "reason": "its disk died"})
        assert not writer._store.accepted
