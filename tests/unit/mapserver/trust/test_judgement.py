"""Judgements: both sides of each limit, votes, clocks, resulting decisions."""

from collections.abc import Iterator
from dataclasses import asdict, replace
from math import log
from typing import Any

import numpy as np
import pytest

from mapserver.calibration.select import FAULT_SIGMAS, MachineErrors
from mapserver.journal.rows import Event
from mapserver.trust.auditor import Verdict
from mapserver.trust.coarse_map import LEVEL_FLOOR, CoarseMap, Surface, pooled
from mapserver.trust.comparison import Difference, Gain
from mapserver.trust.decisions import AUDIT, DISTRUST_AFTER, PERSON, TRUST_AFTER, TrustDecision, TrustDecisions
from mapserver.trust.judgement import (
    AGREE,
    DISAGREE,
    UNKNOWN,
    ClockLeads,
    Judgement,
    Reason,
    beyond_data_sheet,
    faulty,
    judge,
    outvoted,
)
from mapserver.trust.shift import Shift
from mapserver.trust.tuning import TUNING
from protocol.arrays import Ints, Table
from protocol.machine.samples import SCALE_STD, ZERO_STD
from tests.unit.mapserver.data import random_samples, samples

LIMIT, SHARE, FAR_M = TUNING.gain_limit, TUNING.share, TUNING.offset_limit_m
ALIKE = Difference(10**9, Gain(0.0, 0.0, 1.0, 1e9), Shift(0.0, 0.0, 0.0, 1.0), 1.0, (0.5, 0.5))


def gain(ratio: float, **more: float) -> dict[str, Any]:
    return {"gain": replace(ALIKE.gain, log=log(ratio), **more)}


def shift(far_m: float, **more: float) -> dict[str, Any]:
    values = {"east_m": 0.6 * far_m, "north_m": -0.8 * far_m, "std_m": 0.0, "share": 1.0}
    return {"shift": Shift(**(values | more))}


@pytest.mark.parametrize(
    ("reason", "changed", "state"),
    [
        (Reason.GAIN, gain(LIMIT * 1.01), DISAGREE),
        (Reason.GAIN, gain(1 / LIMIT / 1.01), DISAGREE),
        (Reason.GAIN, gain(LIMIT / 1.01), AGREE),
        (Reason.GAIN, gain(LIMIT * 1.01, share=SHARE - 0.01), UNKNOWN),
        (Reason.GAIN, gain(LIMIT * 1.01, std=0.1), UNKNOWN),
        (Reason.GAIN, gain(LIMIT * 1.01, c_rr=TUNING.zero_error), AGREE),
        (Reason.OFFSET, shift(FAR_M + 0.01), DISAGREE),
        (Reason.OFFSET, shift(FAR_M - 0.01), AGREE),
        (Reason.OFFSET, shift(FAR_M + 0.01, share=SHARE - 0.01), UNKNOWN),
        (Reason.OFFSET, shift(FAR_M + 0.01, std_m=0.1), UNKNOWN),
        (Reason.OFFSET, shift(0.0, std_m=FAR_M + 0.01), UNKNOWN),
        (Reason.OFFSET, {"shift": None}, UNKNOWN),
        (Reason.DISAGREES, {"agreement": TUNING.agreement - 0.01}, DISAGREE),
        (Reason.DISAGREES, {"agreement": TUNING.agreement + 0.01}, UNKNOWN),
        (Reason.DISAGREES, {"agreement": TUNING.agreement - 0.01, "cells": 10_000}, UNKNOWN),
        (Reason.DISAGREES, {}, AGREE),
        (Reason.STUCK, {"spreads": (0.5 * TUNING.stuck_spread * 0.99, 0.5)}, DISAGREE),
        (Reason.STUCK, {"spreads": (0.5 * TUNING.stuck_spread * 1.01, 0.5)}, AGREE),
        (Reason.STUCK, {"spreads": (0.0, TUNING.min_spread - 0.01)}, UNKNOWN),
    ],
)
def test_every_limit_counts(reason: Reason, changed: dict[str, Any], state: int) -> None:
    assert judge(replace(ALIKE, **changed), sigmas=2.0)[reason].state == state


@pytest.mark.parametrize("changed", [{"agreement": 0.0}, {"spreads": (0.01, 0.5)}, {"spreads": (0.5, 0.01)}])
def test_between_maps_that_have_nothing_in_common_gain_and_offset_mean_nothing(changed: dict[str, Any]) -> None:
    judgements = judge(replace(ALIKE, **(gain(2.0) | shift(9.0) | changed)), sigmas=0.0)
    assert (judgements[Reason.GAIN].state, judgements[Reason.OFFSET].state) == (UNKNOWN, UNKNOWN)
    assert {judgement.state for judgement in judge(None, sigmas=0.0).values()} == {UNKNOWN}


STATE = MachineErrors(0.0, 0.001, 0.0, 0.01, 0.0, 0.001, ("heights",), ("edges",), (0.0, 0.0))
ZERO_LIMIT, SCALE_LIMIT = FAULT_SIGMAS


@pytest.mark.parametrize(
    ("beyond", "state"),
    [
        ((ZERO_LIMIT * 1.01, 0.0), DISAGREE),
        ((0.0, SCALE_LIMIT * 1.01), DISAGREE),
        ((ZERO_LIMIT * 0.99, SCALE_LIMIT * 0.99), AGREE),
    ],
)
def test_a_zero_or_a_scale_that_no_data_sheet_allows_is_a_fault(beyond: tuple[float, float], state: int) -> None:
    assert beyond_data_sheet(replace(STATE, beyond=beyond)).state == state
    assert beyond_data_sheet(None).state == UNKNOWN
    assert pytest.approx((0.0225, 0.3)) == (ZERO_LIMIT * ZERO_STD, SCALE_LIMIT * SCALE_STD)


@pytest.mark.parametrize(
    ("at_fault", "expected"),
    [
        ("..x", [(), (), (0, 1)]),
        (".x", [(), (0,)]),
        ("x", [()]),
        (".xx", [(), (), ()]),
        (".?xx", [(), (), (0, 1), (0, 1)]),
        ("...", [(), (), ()]),
    ],
)
def test_faults_are_named_as_long_as_half_of_the_machines_are_right(
    at_fault: str, expected: list[tuple[int, ...]]
) -> None:
    known = {"x": Judgement(2.0, DISAGREE), ".": Judgement(0.5, AGREE), "?": Judgement()}
    assert faulty([known[each] for each in at_fault]) == expected


def states(n: int, *against: tuple[int, int], unknown: tuple[tuple[int, int], ...] = ()) -> Ints:
    matrix = np.full((n, n), AGREE)
    np.fill_diagonal(matrix, UNKNOWN)
    for value, pairs in ((DISAGREE, against), (UNKNOWN, unknown)):
        for one, other in pairs:
            matrix[one, other] = matrix[other, one] = value
    return matrix


@pytest.mark.parametrize(
    ("matrix", "expected"),
    [
        (states(2, (0, 1)), [(), ()]),
        (states(3, (0, 2), (1, 2)), [(), (), (0, 1)]),
        (states(3, (0, 1), (0, 2), (1, 2)), [(), (), ()]),
        (states(3, (0, 2), (1, 2), unknown=((0, 1),)), [(), (), ()]),
        (states(4, (0, 2), (0, 3), (1, 2), (1, 3)), [(), (), (), ()]),
        (states(4, (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)), [(), (), (0, 1), (0, 1)]),
        (states(5, *((i, j) for i in (3, 4) for j in range(3))), [(), (), (), (0, 1, 2), (0, 1, 2)]),
        (states(5, *((i, j) for i in (2, 3, 4) for j in range(i))), [()] * 5),
    ],
    ids=["two", "one of three", "each of three", "strangers", "two to two", "two alone", "two alike of five", "most"],
)
def test_the_larger_side_that_agrees_in_itself_outvotes(matrix: Ints, expected: list[tuple[int, ...]]) -> None:
    assert outvoted(matrix) == expected


def judged(sent: Iterator[tuple[str, float]]) -> int:
    """State of x against o after (machine, newest stamp [s]) in order of arrival."""
    clocks = ClockLeads()
    for machine, stamp_s in sent:
        clocks.add(machine, round(stamp_s * 1e9))
    return clocks.compare("x", "o")[1].state


def both(
    pace: float = 1.0, late_s: float = 0.0, jitter_s: float = 0.0, others_stop_s: float = 1e9
) -> Iterator[tuple[str, float]]:
    """Both send every 10 s of the others' time; x late and at its own pace."""
    rng = np.random.default_rng(0)
    for now in range(10_000, 13_000, 10):
        yield "o", min(now, others_stop_s)
        yield "x", min(now, 10_000 + (now - 10_000) * pace - late_s + jitter_s * rng.random())


@pytest.mark.parametrize(
    ("case", "state"),
    [
        ({}, AGREE),
        ({"jitter_s": -200.0}, AGREE),
        ({"late_s": 3600.0}, DISAGREE),
        ({"late_s": 3600.0, "jitter_s": 40.0}, DISAGREE),
        ({"late_s": 3600.0, "jitter_s": 80.0}, UNKNOWN),
        ({"late_s": 86_400.0, "pace": 1.2}, UNKNOWN),
        ({"late_s": 86_400.0, "pace": 20.0}, UNKNOWN),
        ({"others_stop_s": 11_000.0}, UNKNOWN),
    ],
)
def test_only_a_steady_lead_is_a_wrong_clock(case: dict[str, float], state: int) -> None:
    assert judged(both(**case)) == state


def test_a_machine_that_has_caught_up_agrees() -> None:
    assert judged(both(late_s=1000.0, pace=2.0)) == AGREE


def surface_of(parts: list[Table]) -> Surface:
    coarse = CoarseMap(1.0)
    for part in parts:
        coarse.add(part)
    return coarse.surface()


def test_a_cell_keeps_its_metres_and_its_mean_level() -> None:
    surface = surface_of([samples(2, c_rr=[0.02, 0.04], distance_m=[1.0, 3.0])])
    assert surface.metres.tolist() == [4.0]
    expected = (np.log(0.02 + LEVEL_FLOOR) + 3 * np.log(0.04 + LEVEL_FLOOR)) / 4
    assert surface.level == pytest.approx([expected], abs=1e-3)
    assert surface.std_m == pytest.approx(0.1, abs=0.01)


def test_a_pooled_map_without_one_of_its_parts_is_the_map_of_the_rest() -> None:
    one, other = surface_of([random_samples(500, 1)]), surface_of([random_samples(500, 2)])
    rest = pooled([one, other]).without(one)
    assert np.array_equal(rest.codes, other.codes)
    assert np.array_equal(rest.sums, other.sums)
    assert len(pooled([]).codes) == 0


BAD = Verdict("c", (Reason.GAIN, Reason.OFFSET), {"gain": 1.6}, True)
GOOD = Verdict("c", (), {"gain": 1.0}, False, frozenset({Reason.GAIN, Reason.OFFSET, Reason.DISAGREES}))


def decided(decisions: TrustDecisions, verdict: Verdict, times: int) -> list[TrustDecision]:
    """Audit decisions on a repeated verdict, each effective at once."""
    made = []
    for stamp_ns in range(1, times + 1):
        for decision in decisions.judge({verdict.machine: verdict}, stamp_ns):
            decisions.add(decision)
            made.append(decision)
    return made


def test_a_machine_is_distrusted_once_the_verdict_stands():
    decisions = TrustDecisions([])
    assert decided(decisions, BAD, DISTRUST_AFTER - 1) == []
    (decision,) = decided(decisions, BAD, 3)
    assert (decision.machine, decision.trusted, decision.by, decision.reason) == ("c", False, AUDIT, "gain, offset")
    assert decision.evidence == {"gain": 1.6}
    assert decisions.distrusted == {"c"}


def test_a_doubtful_verdict_begins_to_count_anew():
    decisions = TrustDecisions([])
    for _ in range(5):
        assert decided(decisions, BAD, DISTRUST_AFTER - 1) == []
        assert decided(decisions, GOOD, 1) == []


def test_a_machine_that_agrees_again_is_trusted_again_but_later():
    decisions = TrustDecisions([])
    decided(decisions, BAD, DISTRUST_AFTER)
    assert decided(decisions, GOOD, TRUST_AFTER - 1) == []
    (decision,) = decided(decisions, GOOD, 1)
    assert decision.trusted
    assert decisions.distrusted == frozenset()
    assert TRUST_AFTER > DISTRUST_AFTER


@pytest.mark.parametrize("agrees", [(), (Reason.GAIN,), (Reason.OFFSET, Reason.DISAGREES, Reason.CLOCK)])
def test_a_machine_of_which_nothing_shows_that_it_agrees_again_stays_out(agrees):
    decisions = TrustDecisions([])
    decided(decisions, BAD, DISTRUST_AFTER)
    silent = Verdict("c", (), {"cells": 0}, False, frozenset(agrees))
    assert decided(decisions, silent, 3 * TRUST_AFTER) == []
    assert decided(decisions, GOOD, TRUST_AFTER - 1) == []
    assert decided(decisions, silent, 1) == []
    assert decided(decisions, GOOD, TRUST_AFTER - 1) == [], "four in a row"


@pytest.mark.parametrize("trusted", [True, False])
def test_what_a_person_decided_stands_against_the_audit(trusted):
    decisions = TrustDecisions([])
    decisions.add(TrustDecision("c", trusted, PERSON, "because", 1))
    assert decided(decisions, BAD if trusted else GOOD, 20) == []
    assert decisions.distrusted == (frozenset() if trusted else {"c"})


def test_a_decision_handed_back_lets_the_audit_decide():
    decisions = TrustDecisions([])
    decisions.add(TrustDecision("c", False, PERSON, "because", 1))
    decisions.add(TrustDecision("c", True, AUDIT, "left to the audit", 2))
    assert decisions.distrusted == frozenset()
    assert decided(decisions, BAD, DISTRUST_AFTER)


@pytest.mark.parametrize("reasons", [(Reason.BEYOND_DATA_SHEET,), (Reason.OFFSET, Reason.BEYOND_DATA_SHEET)])
def test_a_machine_beyond_its_data_sheet_is_let_in_by_a_person_alone(reasons):
    decisions = TrustDecisions([])
    decided(decisions, Verdict("c", reasons, {}, True), DISTRUST_AFTER)
    assert decided(decisions, GOOD, 20) == []
    assert decisions.distrusted == {"c"}
    decisions.add(TrustDecision("c", True, PERSON, "its samples are corrected", 30))
    assert decisions.distrusted == frozenset()
    assert decided(decisions, Verdict("c", reasons, {}, True), 20) == []


def test_decisions_come_back_from_events_the_newest_of_each_machine():
    made = [
        TrustDecision("c", False, AUDIT, "gain", 1, {"gain": 1.6}),
        TrustDecision("b", False, PERSON, "broken", 2),
        TrustDecision("c", True, PERSON, "repaired", 3),
    ]
    decisions = TrustDecisions(Event(i, "trust", d.stamp_ns, asdict(d)) for i, d in enumerate(made, 1))
    assert decisions.distrusted == {"b"}
    assert decisions.newest("c") == made[2]
    assert decisions.newest("b") == made[1]
