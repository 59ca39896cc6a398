"""Valid corrections: solver hysteresis, people's precedence, events, overlapping spans."""

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from mapserver.calibration.calibrate import Solution
from mapserver.calibration.correction import ANY_SHARE, LAST_NS, LEVEL_SHARE, Correction, at, paint
from mapserver.calibration.decide import EVERY_NS, FROZEN_NS, CalibrationDecisions
from mapserver.calibration.decision import PERSON, SOLVER, CalibrationDecision
from mapserver.calibration.ledger import EPOCH_NS, Stated
from mapserver.calibration.select import CommonScale

SURE = ((2.5e-7, 0.0, 0.0), (0.0, 2.5e-5, 0.0), (0.0, 0.0, 2.5e-7))  # std 0.5e-3, 0.5 %, 0.5e-3
NOW_NS = 1000 * EPOCH_NS


def one(
    zero: float,
    epoch: int = 1000,
    *,
    scale: float = 0.0,
    machine: str = "a",
    to_ns: int = LAST_NS,
    covariance: Sequence[Sequence[float]] = SURE,
    **more: float,
) -> Correction:
    across = more.pop("across", 0.0)
    rows = tuple(map(tuple, covariance))
    return Correction(machine, epoch * EPOCH_NS, to_ns, zero, scale, across, rows, **more)


def solved(*corrections: Correction, begins_ns: int = LAST_NS) -> Solution:
    begins_ns_of = {one.machine: begins_ns for one in corrections}
    return Solution(corrections, {}, CommonScale(True, 0.005, ""), begins_ns=begins_ns_of)


class Solver:
    """Solves a minute apart; decisions are effective at once."""

    def __init__(self, *decisions: CalibrationDecision) -> None:
        self.decisions = CalibrationDecisions(decisions)
        self.now_ns = NOW_NS

    def hears(
        self, *corrections: Correction, asked: bool = False, after_ns: int = 60 * 10**9, begins_ns: int = LAST_NS
    ) -> int:
        """Number of corrections decided."""
        made = self.decisions.judge(solved(*corrections, begins_ns=begins_ns), self.now_ns, asked=asked)
        for decision in made:
            self.decisions.add(CalibrationDecision.from_body(json.loads(json.dumps(decision.body()))))
        self.now_ns += after_ns
        return sum(len(decision.corrections) for decision in made)

    def watches(self, time_ns: int, *corrections: Correction) -> None:
        """So long, with unchanged solves."""
        for _ in range(time_ns // EVERY_NS):
            self.hears(*corrections, after_ns=EVERY_NS)

    def zero(self, epoch: float = 1000, machine: str = "a") -> float | None:
        own = [each for each in self.decisions.corrections.each if each.machine == machine]
        counts = at(own, round(epoch * EPOCH_NS))
        return counts and counts.zero


def test_the_first_correction_of_a_machine_counts_at_once():
    """Earlier samples have all of its zero's error, and no other map is known."""
    solver = Solver()
    assert [solver.hears(one(0.003)) for _ in range(3)] == [1, 0, 0]
    assert solver.zero() == 0.003
    assert solver.zero(5000) == 0.003, "it holds until there is a newer one"
    assert solver.zero(999.9) is None


@pytest.mark.parametrize(
    ("off", "counts"),
    [
        ({"zero": 0.00301}, True),
        ({"zero": 0.00249}, False),
        ({"zero": 0.002, "scale": 0.006}, True),
        ({"zero": 0.002, "scale": -0.0049}, False),
        ({"zero": 0.002, "across": 0.0006}, True),
        ({"zero": 0.002, "most_share": LEVEL_SHARE}, True),
        ({"zero": 0.004, "covariance": 17 * np.array(SURE)}, False),
        ({"zero": 0.0024, "covariance": 0.01 * np.array(SURE)}, False),
    ],
)
def test_what_differs_by_less_than_it_is_unsure_changes_nothing(off, counts):
    solver = Solver()
    solver.hears(one(0.002))
    solver.hears(one(0.002), after_ns=EVERY_NS)
    assert [solver.hears(one(**off)) for _ in range(2)] == [0, int(counts)]


def test_the_solver_decides_at_most_once_in_ten_minutes_of_site_time_unless_it_is_asked():
    solver = Solver()
    counts = [solver.hears(one(0.002 + 0.002 * (minute // 2))) for minute in range(14)]
    assert np.flatnonzero(counts).tolist() == [0, 10]
    assert solver.hears(one(0.1), asked=True) == 1
    started_anew = Solver(*[CalibrationDecision("a", SOLVER, "", solver.now_ns, (one(0.1),))])
    started_anew.now_ns = solver.now_ns
    assert [started_anew.hears(one(0.2)) for _ in range(11)] == [0] * 10 + [1], "its last decision is on disk"


@pytest.mark.parametrize(
    ("begun_min", "decided"),
    [
        (0, [0, 3, 7, 15, 25]),  # 1, 4, 8, 16 minutes after the first sample, then every 10
        (-60, [0, 10, 20]),
        (1, [0, 3, 6, 12, 22]),  # first sample with the first decision
        (10**6, [0, 10, 20]),  # a clock is ahead
    ],
)
def test_in_the_first_minutes_of_machines_it_decides_again_when_twice_the_time_has_passed(begun_min, decided):
    solver = Solver()
    begins_ns = NOW_NS - 60 * 10**9 * (1 - begun_min)
    counts = [solver.hears(one(0.002 + 0.002 * (minute // 2)), begins_ns=begins_ns) for minute in range(30)]
    assert np.flatnonzero(counts).tolist() == decided


def test_while_a_clock_is_ahead_and_after_a_night_what_is_half_learned_is_learned_on():
    solver = Solver()
    solver.watches(2 * EVERY_NS, one(0.002))
    solver.now_ns += 23 * 3600 * 10**9
    assert [solver.hears(one(0.004)) for _ in range(2)] == [0, 1]


def test_a_server_that_starts_while_a_clock_is_ahead_freezes_nothing_new():
    solver = Solver(CalibrationDecision("a", SOLVER, "", 1, (one(0.002), one(0.002, 990))))
    solver.now_ns += 23 * 3600 * 10**9
    assert [solver.hears(one(0.004)) for _ in range(2)] == [0, 1]
    old = Solver(CalibrationDecision("a", SOLVER, "", 1, (one(0.002, 900),)))
    assert [old.hears(one(0.004, 900), one(0.002, 1000)) for _ in range(2)] == [0, 0]


def test_epochs_are_decided_each_by_itself_and_what_follows_keeps_the_newest():
    solver = Solver()
    for _ in range(2):
        solver.hears(one(0.003, 998, to_ns=999 * EPOCH_NS), one(-0.003, 1000))
    assert [solver.zero(epoch) for epoch in (998, 999, 1000, 1001)] == [0.003, 0.003, -0.003, -0.003]
    solver.now_ns += EVERY_NS
    for _ in range(2):
        solver.hears(one(0.005, 998, to_ns=999 * EPOCH_NS), one(-0.003, 1000))
    assert [solver.zero(epoch) for epoch in (998, 999.5, 1000)] == [0.005, 0.005, -0.003]


def test_an_old_epoch_keeps_its_correction_unless_a_person_asks():
    solver = Solver()
    solver.watches(FROZEN_NS + 2 * EVERY_NS, one(0.003))
    later = one(0.001, 1000 + FROZEN_NS // EPOCH_NS)
    for _ in range(3):
        assert solver.hears(one(0.03), later) <= 1
    assert (solver.zero(), solver.zero(1000 + FROZEN_NS / EPOCH_NS)) == (0.003, 0.001)
    assert solver.hears(one(0.03), later, asked=True) == 1
    assert solver.zero() == 0.03


def test_samples_that_come_hours_late_are_corrected():
    solver = Solver()
    solver.hears(one(0.003))
    solver.now_ns += 10 * FROZEN_NS
    late = one(0.004, machine="late")
    assert [solver.hears(one(0.003), late, after_ns=EVERY_NS) for _ in range(2)] == [1, 0]
    assert solver.zero(machine="late") == 0.004


def person(zero: float | None, *, machine: str = "a") -> CalibrationDecision:
    corrections = () if zero is None else (Correction(machine, 0, LAST_NS, zero, 0.0, 0.0, ()),)
    return CalibrationDecision(machine, PERSON, "why", NOW_NS, corrections)


def test_a_person_s_correction_stands_until_it_is_taken_back():
    solver = Solver()
    for _ in range(2):
        solver.hears(one(0.003))
    solver.decisions.add(person(0.02))
    assert (solver.zero(), solver.zero(3)) == (0.02, 0.02)
    assert solver.decisions.newest("a").by == PERSON
    solver.now_ns += EVERY_NS
    assert [solver.hears(one(0.05), asked=asked) for asked in (False, False, True)] == [0, 0, 0]
    solver.decisions.add(person(None))
    assert (solver.zero(), solver.zero(3)) == (0.003, None)
    assert solver.decisions.newest("a").by == SOLVER
    assert [solver.hears(one(0.05)) for _ in range(2)] == [0, 1]


@pytest.mark.parametrize(
    ("name", "value"), [("zero", math.nan), ("rolls", -1.0), ("rolls", math.inf), ("drags", math.nan)]
)
def test_a_correction_that_no_solver_made_is_refused(name: str, value: float):
    made = person(0.02)
    body = replace(made, corrections=(replace(made.corrections[0], **{name: value}),)).body()
    with pytest.raises(ValueError, match="no solver made"):
        CalibrationDecision.from_body(body)


def test_painted_spans_are_what_painting_each_time_by_itself_gives():
    draw, spans, times = np.random.default_rng(0), [], np.full(60, np.nan)
    for zero in range(40):
        first, end = sorted(draw.choice(61, 2, replace=False).tolist())
        paint(spans, Correction("a", first, end, float(zero), 0.0, 0.0, ()))
        times[first:end] = zero
        assert all(before.to_ns <= after.from_ns for before, after in pairwise(spans))
        by_time = [at(spans, stamp) for stamp in range(60)]
        assert np.array_equal([each.zero if each else np.nan for each in by_time], times, equal_nan=True)


@pytest.mark.parametrize(
    ("begins", "applied", "expected"),
    [
        ({}, {}, 0),
        ({"a": 900 * EPOCH_NS}, {}, 900),
        ({"a": 1002 * EPOCH_NS}, {}, 1000),
        ({}, {1000: Stated(0.001)}, 1000),  # earlier samples had the machine's own zero
    ],
)
def test_the_first_correction_of_a_machine_is_that_of_all_its_samples_before(begins, applied, expected):
    decisions = CalibrationDecisions()
    for epoch in (1000, 1002):
        calibration = solved(one(0.003, epoch), one(0.005 * (epoch - 999), epoch + 1))
        calibration = replace(calibration, begins_ns=begins, stated={"a": applied})
        for decision in decisions.judge(calibration, NOW_NS, asked=True):
            decisions.add(decision)
    assert [each.from_ns // EPOCH_NS for each in decisions.corrections.each] == [expected, 1001, 1002, 1003]


def test_before_what_the_machine_knows_itself_nothing_is_corrected():
    calibration = solved(one(0.003, 1000), one(0.02, 1001))
    calibration = replace(calibration, begins_ns={}, stated={"a": {1000: Stated(0.003), 1001: Stated(0.003)}})
    decisions = CalibrationDecisions()
    for minute in range(2):
        for decision in decisions.judge(calibration, NOW_NS + minute):
            decisions.add(decision)
    assert [each.from_ns // EPOCH_NS for each in decisions.corrections.each] == [1001]


def test_what_the_solver_says_again_is_as_of_now():
    solver = Solver()
    for _ in range(2):
        solver.hears(one(0.003))
    assert solver.decisions.as_of_ns("a") == NOW_NS + 60 * 10**9
    solver.now_ns += 6 * EVERY_NS
    solver.hears(one(0.0031, 1012))
    said_ns = NOW_NS + 120 * 10**9 + 6 * EVERY_NS
    assert solver.decisions.as_of_ns("a") == said_ns, "the same in an hour"
    solver.hears(one(0.009, 1012))
    assert solver.decisions.as_of_ns("a") == said_ns, "in doubt"
    old = CalibrationDecision("a", SOLVER, "", solver.now_ns, (one(0.1, 990, to_ns=991 * EPOCH_NS),))
    solver.decisions.add(old)
    assert solver.decisions.as_of_ns("a") == said_ns, "a decision about earlier samples says nothing of these"
    solver.decisions.add(person(0.02))
    assert solver.decisions.as_of_ns("a") == NOW_NS


def test_what_is_known_of_a_machine_that_stands_is_as_of_its_last_epoch():
    """Others drive on, so it is solved for repeatedly without new evidence."""
    solver = Solver()
    solver.now_ns += EVERY_NS
    own = [one(0.003, epoch) for epoch in (999, 1000)]
    solver.hears(*own, after_ns=EVERY_NS)
    assert solver.decisions.as_of_ns("a") == NOW_NS + EPOCH_NS
    solver.watches(20 * EVERY_NS, *own)
    assert solver.decisions.as_of_ns("a") == NOW_NS + EPOCH_NS


def unknown(zero: float, epoch: int, across_std: float = 0.0045, **more: float) -> Correction:
    """No samples on slopes."""
    covariance = np.diag([1e-6, 2e-3, across_std**2]).tolist()
    return one(zero, epoch, most_share=LEVEL_SHARE, covariance=covariance, **more)


def test_a_scale_and_a_lateral_zero_that_are_found_late_are_those_of_all_samples():
    """Else the map would step at the time of discovery, like changed ground."""
    solver = Solver()
    old = [unknown(0.002 * (i + 1), 1000 + i) for i in range(3)]
    solver.watches(2 * EVERY_NS, *old)
    now = 1000 + FROZEN_NS // EPOCH_NS
    solver.watches(FROZEN_NS + 2 * EVERY_NS, *old)
    known = [one(0.009, 1002, scale=0.08, across=0.003), one(0.004, now, scale=0.08, across=0.003)]
    for _ in range(2):
        solver.hears(*known)
    spans = solver.decisions.corrections.spans_of("a")
    assert [each.from_ns // EPOCH_NS for each in spans] == [1000, 1001, 1002, now]
    assert [each.zero for each in spans] == [0.002, 0.004, 0.006, 0.004], "old zeros stay"
    assert {(each.scale, each.across, each.most_share) for each in spans} == {(0.08, 0.003, ANY_SHARE)}
    variances = np.array([np.diag(each.covariance) for each in spans])
    assert np.unique(variances[:, 1:], axis=0).tolist() == [np.diag(SURE)[1:].tolist()]
    assert variances[:3, 0].tolist() == [1e-6] * 3


def test_what_was_shown_of_a_scale_then_stays():
    """After a repair, an earlier finding held for its time; and faults begin somewhere."""
    solver = Solver()
    solver.watches(2 * EVERY_NS, one(0.001, scale=0.08))
    later = one(0.001, 1100, scale=-0.02)
    for _ in range(2):
        solver.hears(later)
    assert [each.scale for each in solver.decisions.corrections.each] == [0.08, -0.02]
    solver = Solver()
    solver.watches(2 * EVERY_NS, unknown(0.003, 1000))
    for _ in range(2):
        solver.hears(one(0.001, 1100, scale=0.4))
    assert [each.scale for each in solver.decisions.corrections.each] == [0.0, 0.4]


@pytest.mark.parametrize("groups", [1, 2, 3])
def test_what_is_wanted_of_machines_waits_for_the_next_decision_whoever_is_solved_then(groups):
    solver, stamps_ns = Solver(), set[int]()
    for minute in range(120):
        solver.hears(one(0.001 * (minute // groups // 2), machine=f"m{minute % groups}"))
        stamps_ns.add(solver.decisions.decided_ns or NOW_NS)
        for group in range(groups):
            least = 0.001 * ((minute - 10 - 2 * groups) // groups // 2)
            assert (solver.zero(machine=f"m{group}") or 0.0) >= least, "no older than a decision and a round"
    assert min(after - before for before, after in pairwise(sorted(stamps_ns)[1:])) >= EVERY_NS


def test_what_cannot_be_decided_now_is_not_forgotten():
    """The map is behind or nothing could be written: the caller adds nothing."""
    decisions = CalibrationDecisions()
    for minute in range(2):
        made = decisions.judge(solved(one(0.003)), NOW_NS + minute)
        assert len(made) == 1
    others = decisions.judge(solved(one(0.0001, machine="c")), NOW_NS + 3)
    assert [each.machine for each in others] == ["a"]
    decisions.add(others[0])
    assert decisions.judge(solved(one(0.001, machine="b")), NOW_NS + EVERY_NS + 3)[0].machine == "b"


def test_neighbours_that_do_the_same_become_one():
    spans = []
    for first, zero in ((0, 0.1), (3, 0.1), (6, 0.2), (4, 0.1), (5, 0.2), (1, 0.2), (1, 0.1)):
        paint(spans, Correction("a", first, first + (3 if first % 3 == 0 else 1), zero, 0.0, 0.0, ((float(first),),)))
    assert [(each.from_ns, each.to_ns, each.zero) for each in spans] == [(0, 5, 0.1), (5, 9, 0.2)]
