"""Routes and ways over maps from samples: costs, lines, named machines, refusals."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mapserver.query.answering import Answers
from mapserver.query.named_machines import LOOK_BACK_NS, NamedMachines
from protocol.arrays import Table
from protocol.errors import QueryError, Refusal
from protocol.queries.requests import parse_query
from protocol.queries.route_requests import REFUSE, TIME, RouteQuery, WayQuery
from protocol.queries.routing import LOADER, MACHINES, NamedMachine, RouteAnswer, RouteMachine, decode_answer
from protocol.units import GRAVITY_MPS2
from tests.unit.mapserver.data import NOW_NS, SITE, incoming, open_writer, refused, samples, send
from tests.unit.mapserver.query.fake_upkeep import answers_of

HALF = 60
SLOW = RouteMachine(mass_kg=20_000.0, speed_mps=2.0)
WEIGHT_N = 20_000 * GRAVITY_MPS2
ROLLING = (False, False)


def ground(resistance, grade_e=lambda x, y: 0 * x, skipped=lambda x, y: x != x):
    """A sample per cell with its resistance and slope."""
    x, y = (axis.reshape(-1) + 0.5 for axis in np.meshgrid(np.arange(-HALF, HALF), np.arange(-HALF, HALF)))
    here = ~skipped(x, y)
    x, y = x[here], y[here]
    rows = samples(len(x), x_m=x, y_m=y, distance_m=8.0)
    rows["c_rr"], rows["grade_e"], rows["grade_n"] = resistance(x, y), grade_e(x, y), 0.0
    return rows


@contextmanager
def answers_on(folder: Path, rows: Table, cell_m: float = 1.0) -> Iterator[Answers]:
    with closing(open_writer(folder, site=replace(SITE, cell_m=cell_m))) as writer:
        send(writer, [incoming(rows)])
        yield answers_of(writer)


def ask(answers: Answers, query: RouteQuery | WayQuery) -> RouteAnswer:
    """Through the bytes of query and answer."""
    again = parse_query(query.name, query.parameters())
    assert again == query
    return decode_answer(answers.answer(again))


def test_two_soils_cost_what_each_does_over_its_length(tmp_path):
    """Half gravel, half wet dirt on a rising plane: the sum of both, none lost to brakes."""
    soils = lambda x, y: np.where(x < 0, 0.02, 0.06)  # noqa: E731
    with answers_on(tmp_path, ground(soils, lambda x, y: 0.015 + 0 * x)) as answers:
        there, back = (
            ask(answers, RouteQuery(line, machine=SLOW, stops=ROLLING))
            for line in (((-40, 5.0), (40, 5.0)), ((40, 5.0), (-40, 5.0)))
        )
        assert there.totals.energy_j == pytest.approx(WEIGHT_N * (0.02 * 40 + 0.06 * 40 + 0.015 * 80), rel=0.02)
        assert back.totals.energy_j == pytest.approx(WEIGHT_N * (0.02 * 40 + 0.06 * 40 - 0.015 * 80), rel=0.03)
        assert there.totals.energy_j - back.totals.energy_j == pytest.approx(2 * WEIGHT_N * 0.015 * 80, rel=0.01)
        assert max(there.totals.braked_j, back.totals.braked_j) < 0.01 * back.totals.energy_j  # of one border
        assert there.totals.time_s == pytest.approx(80 / SLOW.speed_mps)
        assert there.machine == SLOW
        for name in ("energy_j", "time_s"):
            assert getattr(there.steps, name).sum() == pytest.approx(getattr(there.totals, name))
        assert (there.merged, there.totals.unknown, there.line_m.tolist()) == (1, 0.0, [[-40, 5], [40, 5]])


@pytest.mark.parametrize(("cell_m", "edge_m"), [(1.0, 25), (2.0, 40)])
def test_a_way_leads_around_sand_and_costs_less_than_straight(tmp_path, cell_m, edge_m):
    sand = lambda x, y: (abs(x) < 15) & (y < edge_m)  # noqa: E731
    with answers_on(tmp_path, ground(lambda x, y: np.where(sand(x, y), 0.25, 0.02)), cell_m) as answers:
        ends = (-40.0, 0.0), (40.0, 0.0)
        way = ask(answers, WayQuery(*ends, machine=SLOW, stops=ROLLING))
        straight = ask(answers, RouteQuery(ends, machine=SLOW, stops=ROLLING))
        assert way.line_m[[0, -1]].tolist() == [[-40, 0], [40, 0]]
        assert way.line_m[:, 1].max() > edge_m - cell_m
        assert way.totals.energy_j < 0.5 * straight.totals.energy_j
        assert way.steps.resistance.max() < 0.1
        again = ask(answers, RouteQuery(tuple(map(tuple, way.line_m.tolist())), machine=SLOW, stops=ROLLING))
        assert again.totals.energy_j == pytest.approx(way.totals.energy_j)


def test_unknown_ground_is_dear_refused_or_as_told(tmp_path):
    gap = lambda x, y: (abs(x) < 10) & (y < 40)  # noqa: E731
    soils = lambda x, y: np.where(y > 45, 0.08, 0.02)  # noqa: E731
    with answers_on(tmp_path, ground(soils, skipped=gap)) as answers:
        ends = (-30.0, -30.0), (30.0, -30.0)
        refused = ask(answers, WayQuery(*ends, machine=SLOW, unknown=REFUSE))
        assert refused.totals.unknown == 0.0
        assert refused.line_m[:, 1].max() > 34
        cheap = ask(answers, WayQuery(*ends, machine=SLOW, unknown=0.02))
        assert len(cheap.line_m) == 2
        with pytest.raises(QueryError, match=r"unknown ground at -?\d, -30 m; without `unknown=refuse` it has a cost"):
            ask(answers, RouteQuery(ends, machine=SLOW, unknown=REFUSE))
        with pytest.raises(QueryError, match="parameter `to`: unknown ground"):
            ask(answers, WayQuery((-30.0, -30.0), (0.0, 0.0), machine=SLOW, unknown=REFUSE))


def test_a_way_keeps_to_a_road_of_fifteen_degrees(tmp_path):
    """Unknown ground beside it is no free climb, though most known ground is even."""
    up = lambda x, y: np.where(abs(x) < 10, 0.27, 0.0)  # noqa: E731
    beside = lambda x, y: (abs(y) > 2) & (abs(x) < 45)  # noqa: E731
    with answers_on(tmp_path, ground(lambda x, y: 0.03 + 0 * x, up, beside)) as answers:
        for ends in (((-50.0, 0.0), (50.0, 20.0)), ((-50.0, -30.0), (50.0, 30.0))):
            way = ask(answers, WayQuery(*ends, machine=SLOW, stops=ROLLING))
            assert way.totals.lift_m == pytest.approx(20 * 0.27, rel=0.2)
            middle = ask(
                answers, RouteQuery(tuple(map(tuple, way.line_m.tolist())), machine=SLOW, stops=ROLLING, step_m=1.0)
            ).steps
            assert abs(middle.y_m[abs(middle.x_m) < 10]).max() < 4.0
        off = ask(answers, RouteQuery(((-50, 0), (-40, 20), (40, 20), (50, 0)), machine=SLOW, stops=ROLLING)).totals
        assert off.unknown > 0.6
        assert off.lift_m == pytest.approx(20 * 0.27, rel=0.1), "heights at both ends of the unknown are known"


def test_unknown_ground_costs_the_same_whoever_asks_from_wherever(tmp_path):
    gap = lambda x, y: (abs(x) < 14) & (abs(y) < 50)  # noqa: E731
    soils = lambda x, y: np.where(y > 45, 0.08, np.where(x < 0, 0.02, 0.05))  # noqa: E731
    with answers_on(tmp_path, ground(soils, lambda x, y: 0.001 * x, skipped=gap)) as answers:
        for ends in (((-20.0, 0.0), (20.0, 0.0)), ((20.0, -55.0), (-30.0, 58.0))):
            way = ask(answers, WayQuery(*ends, machine=SLOW))
            line = tuple(map(tuple, way.line_m.tolist()))
            again, straight = ask(answers, RouteQuery(line, machine=SLOW)), ask(answers, RouteQuery(ends, machine=SLOW))
            assert again.totals == way.totals
            assert way.totals.energy_j <= straight.totals.energy_j
        then = ask(answers, WayQuery(*ends, machine=SLOW, as_of_ns=way.stamp_ns))
        assert then.line_m.tolist() == way.line_m.tolist()
        assert then.totals == way.totals, "as of a time as now"
        long, short = (
            ask(answers, RouteQuery(((-x, 3.0), (x, 3.0)), machine=SLOW, step_m=1.0)).steps for x in (58.0, 12.0)
        )
        assert long.resistance[46:70] == pytest.approx(short.resistance)
        alone = ask(answers, RouteQuery(((-2.0, 3.0), (2.0, 3.0)), machine=SLOW)).totals
        assert alone.unknown_resistance == pytest.approx(short.resistance[10:14].mean())
        assert ask(answers, RouteQuery(((20.0, 0.0), (50.0, 0.0)), machine=SLOW)).totals.unknown_resistance == 0.0


def test_no_drive_over_the_way_is_dearer_than_straight_on(tmp_path):
    """Cells ignore stops and curves: a detour saving less than those cost is none."""
    rough = lambda x, y: (abs(x) < 8) & (y > -4)  # noqa: E731
    for share in (1.02, 1.3):
        rows = ground(lambda x, y, over=share: np.where(rough(x, y), 0.03 * over, 0.03))
        with answers_on(tmp_path / str(share), rows) as answers:
            ends = (-30.0, 0.0), (30.0, 0.0)
            for cost, total in (("energy", "energy_j"), (TIME, "time_s")):
                way, straight = ask(answers, WayQuery(*ends, cost=cost)), ask(answers, RouteQuery(ends))
                assert getattr(way.totals, total) <= getattr(straight.totals, total)
            limited = ask(answers, WayQuery(*ends, margin_m=6.0, avoid=((0.0, 0.0),)))
            assert len(limited.line_m) > 2, "straight on leads past what it is to avoid"


def test_margins_keep_away_from_parked_machines(tmp_path):
    with answers_on(tmp_path, ground(lambda x, y: 0.02 + 0 * x)) as answers:
        ends, parked = ((-40.0, 0.0), (40.0, 0.0)), ((0.0, 0.0), (10.0, 3.0))
        way = ask(answers, WayQuery(*ends, machine=SLOW, margin_m=8.0, avoid=parked))
        along = np.concatenate([np.linspace(a, b, 200) for a, b in zip(way.line_m[:-1], way.line_m[1:], strict=True)])
        for place in parked:
            assert np.hypot(*(along - place).T).min() > 7.0
        with pytest.raises(QueryError, match="parameter `from`: nearer than `margin` to what no way leads over"):
            ask(answers, WayQuery((1.0, 1.0), ends[1], machine=SLOW, margin_m=8.0, avoid=parked))


def test_no_way_says_which_limit_leaves_none(tmp_path):
    wall = lambda x, y: np.where(abs(x) < 6, 0.25, 0.0)  # noqa: E731
    with answers_on(tmp_path, ground(lambda x, y: 0.02 + 0 * x, wall)) as answers:
        ends = (-40.0, 0.0), (40.0, 0.0)
        assert ask(answers, WayQuery(*ends, machine=SLOW, unknown=REFUSE)).totals.length_m == pytest.approx(80)
        with pytest.raises(QueryError, match="no way: `max_grade` leaves none"):
            ask(answers, WayQuery(*ends, machine=SLOW, max_grade=0.1, unknown=REFUSE))
        row = tuple((0.0, float(y)) for y in range(-HALF - 10, HALF + 10))
        with pytest.raises(QueryError, match="no way: `margin` leaves none"):
            ask(answers, WayQuery(*ends, machine=SLOW, margin_m=5.0, avoid=row, unknown=REFUSE))
        with pytest.raises(QueryError, match=r"parameter `to`: 25% steep, over `max_grade`"):
            ask(answers, WayQuery(ends[0], (0.0, 0.0), machine=SLOW, max_grade=0.1))


def test_the_fastest_way_is_not_the_cheapest(tmp_path):
    soils = lambda x, y: np.where(abs(y) < 20, 0.045, 0.02)  # noqa: E731
    with answers_on(tmp_path, ground(soils)) as answers:
        strong = RouteMachine(mass_kg=20_000.0, speed_mps=4.0, power_w=400_000.0)
        ends = (-50.0, 0.0), (50.0, 0.0)
        cheapest, fastest = (ask(answers, WayQuery(*ends, machine=strong, cost=cost)) for cost in ("energy", TIME))
        assert abs(cheapest.line_m[:, 1]).max() > 19
        assert len(fastest.line_m) == 2
        assert cheapest.totals.energy_j < fastest.totals.energy_j
        assert fastest.totals.time_s < cheapest.totals.time_s


def test_an_empty_map_knows_no_cost(tmp_path):
    with closing(open_writer(tmp_path)) as writer:
        answers = answers_of(writer)
        for query in (RouteQuery(((0.0, 0.0), (30.0, 0.0))), WayQuery((0.0, 0.0), (30.0, 0.0))):
            with pytest.raises(QueryError, match="nobody has driven near"):
                ask(answers, query)
        given = ask(answers, WayQuery((0.0, 0.0), (30.0, 0.0), machine=SLOW, unknown=0.05, stops=ROLLING))
        assert given.totals.energy_j == pytest.approx(WEIGHT_N * 0.05 * 30)


def test_what_lies_off_the_site_is_refused_by_name(tmp_path):
    with answers_on(tmp_path, ground(lambda x, y: 0.02 + 0 * x)) as answers:
        for name, query in (
            ("line", RouteQuery(((0.0, 0.0), (90_000.0, 0.0)))),
            ("to", WayQuery((0.0, 0.0), (90_000.0, 0.0))),
            ("from", WayQuery((0.0, -90_000.0), (0.0, 0.0))),
            ("avoid", WayQuery((0.0, 0.0), (9.0, 0.0), avoid=((1e6, 0.0),))),
        ):
            with pytest.raises(QueryError, match=f"parameter `{name}`: .* is off the site"):
                ask(answers, query)


S = 10**9
LINE = ((0.0, 8.5), (20.0, 8.5))


def drive(stamp_ns: int, mass_kg: float, speed_mps: float = 5.0, n: int = 20):
    rows = samples(n, x_m=np.arange(n) + 0.5, stamp_ns=stamp_ns + np.arange(n) * S, mass_kg=mass_kg)
    rows["speed_mps"] = speed_mps
    return rows


@pytest.fixture
def answers(tmp_path):
    """A truck loaded after half an hour, one without a scale, and a loader last heard two hours ago."""
    with closing(open_writer(tmp_path)) as writer:
        half_hour, hours = 1800 * S, 7200 * S
        batches = [
            incoming(drive(NOW_NS, 9e3, 9.0), machine="loader-9"),
            incoming(drive(NOW_NS + hours, 22e3, 7.5), machine="truck-1"),
            incoming(drive(NOW_NS + hours + half_hour, 47e3, 6.0), 21, machine="truck-1"),
            incoming(drive(NOW_NS + hours + half_hour, np.nan, -0.5), machine="dumper"),
        ]
        send(writer, batches)
        yield answers_of(writer)


def asked(answers, machine: NamedMachine, as_of_ns: int | None = None):
    query = RouteQuery(LINE, machine=machine, stops=(False, False), as_of_ns=as_of_ns)
    return decode_answer(answers.answer(query))


def test_a_named_machine_weighs_what_it_said_last_and_drives_as_fast_as_it_did(answers):
    truck = asked(answers, NamedMachine("truck-1")).machine
    assert truck == replace(MACHINES["truck"], mass_kg=47e3, speed_mps=7.5)
    given = asked(answers, NamedMachine("truck-1", (("mass_kg", 30e3), ("speed_mps", 3.0)))).machine
    assert given == replace(truck, mass_kg=30e3, speed_mps=3.0), "what is given holds"
    then = asked(answers, NamedMachine("truck-1"), NOW_NS + 7200 * S + 60 * S).machine
    assert then.mass_kg == 22e3
    early = asked(answers, NamedMachine("loader-9"), NOW_NS + 60 * S).machine
    assert (early.mass_kg, early.speed_mps) == (9e3, 9.0)
    assert asked(answers, NamedMachine("loader-9")).machine == MACHINES["loader"], "it said so long ago"
    assert asked(answers, NamedMachine("dumper")).machine == LOADER, "it hardly moved: that is no speed"


def test_a_name_that_sent_nothing_is_refused_with_those_that_did(answers):
    problem = "'truck-7' has sent nothing to this site; machines: dumper, loader-9, truck-1; kinds:"
    with refused(Refusal.OUT_OF_RANGE, problem):
        asked(answers, NamedMachine("truck-7"))


def test_new_samples_are_followed_and_old_ones_forgotten(tmp_path):
    with closing(open_writer(tmp_path)) as writer:
        send(writer, [incoming(drive(NOW_NS, 22e3), machine="truck-1")])
        answers = answers_of(writer)
        machines = NamedMachines(answers.source)
        assert machines.resolve(NamedMachine("truck-1"), None).mass_kg == 22e3
        send(writer, [incoming(drive(NOW_NS + 60 * S, 40e3), 21, machine="truck-1")])
        assert machines.resolve(NamedMachine("truck-1"), None).mass_kg == 40e3
        late_ns = NOW_NS + 3 * LOOK_BACK_NS
        send(writer, [incoming(drive(late_ns, np.nan), 41, machine="truck-1")])
        assert machines.resolve(NamedMachine("truck-1"), None).mass_kg == MACHINES["truck"].mass_kg
        fresh = NamedMachines(answers.source)
        assert fresh.resolve(NamedMachine("truck-1"), None) == machines.resolve(NamedMachine("truck-1"), None)
