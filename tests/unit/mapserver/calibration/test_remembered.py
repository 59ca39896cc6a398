"""Observed corrections hold until contradicted; those of nobody identifiable are not applied."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from mapserver.calibration.calibrate import calibrate
from mapserver.calibration.correction import ANY_SHARE, LAST_NS, LEVEL_SHARE, NO_SHARE, Correction
from mapserver.calibration.decide import EVERY_NS, CalibrationDecisions
from mapserver.calibration.decision import SOLVER, CalibrationDecision
from mapserver.calibration.ledger import EPOCH_NS, StayLedger, newest, stated
from mapserver.calibration.select import REMEMBERED_STD, remembered_of
from protocol.arrays import Floats, Table
from protocol.machine.samples import SCALE_STD, ZERO_STD
from tests.unit.mapserver.calibration.drives import (
    FOOT_M,
    LOW,
    OPEN,
    RAMP,
    RAMP_AGAIN,
    START_NS,
    Errors,
    Site,
    drive,
    height_slope,
    ledgers,
    soils,
)

S = 10**9
ERRORS = {"a": Errors(0.0, 0.2), "b": Errors(0.002, 0.0), "c": Errors(0.004, 0.03)}
BOTH = ((20.0, 10.0), (110.0, 10.0))  # up and down the ramp, one lane
ROUTES = {"a": RAMP, "b": RAMP_AGAIN, "c": RAMP}
SURE = ((1.6e-7, 0.0, 0.0), (0.0, 1.6e-5, 0.0), (0.0, 0.0, 1.6e-7))
KNOWN = [Correction(name, 0, 1, 0.0, e.scale / (1 + e.scale), 0.0, SURE) for name, e in ERRORS.items()]


def test_a_scale_that_was_observed_stays_where_nothing_shows_it_any_more() -> None:
    """15 minutes on a ramp, then level until no evidence of the ramp is left."""
    sites, decisions = {name: StayLedger() for name in ERRORS}, CalibrationDecisions()
    for quarter in range(3):
        for i, (name, ledger) in enumerate(sites.items()):
            route = LOW if quarter else ROUTES[name]
            rows = drive(route, ERRORS[name], seconds=900.0, seed=10 * quarter + i, start_s=900.0 * quarter)
            ledger.add(rows)
        stays = {name: newest(ledger.stays(), 3) for name, ledger in sites.items()}
        for minute in range(2):
            solved = calibrate(stays, remembered=remembered_of(decisions.shown()))
            now_ns = START_NS + 900 * (quarter + 1) * S + 60 * minute * S
            for decision in decisions.judge(solved, now_ns):
                decisions.add(decision)
        for one in decisions.corrections.each:
            assert one.most_share == ANY_SHARE
            assert one.scale == pytest.approx(ERRORS[one.machine].scale / (1 + ERRORS[one.machine].scale), abs=0.02)
    assert not calibrate(stays).common.observed, "these stays alone show nothing of it"
    assert solved.machines["a"].scale_by == ("remembered",)
    assert solved.machines["a"].scale_std < REMEMBERED_STD, "what three remember together is surer"


def paved(x_m: Floats, y_m: Floats, heading: Floats) -> Floats:
    """Ramps on better ground than around."""
    return soils(x_m, y_m, heading) - 0.02 * (height_slope(x_m) > 0)


def borders(x_m: Floats, y_m: Floats, _: Floats) -> Floats:
    """Soil borders at the foot of two of three lanes."""
    return 0.03 + 0.02 * ((y_m < 17.0) & (x_m > FOOT_M)) + 0.02 * ((y_m > 32.0) & (x_m < FOOT_M))


@pytest.mark.parametrize(("site", "reason"), [(paved, "ground_changes_with_slope"), (borders, "places_disagree")])
def test_a_scale_that_was_shown_counts_where_slopes_contradict_each_other(site: Site, reason: str) -> None:
    rows = {name: drive(ROUTES[name], e, site=site, seed=i) for i, (name, e) in enumerate(ERRORS.items())}
    alone = calibrate(ledgers(rows))
    assert (alone.common.reason, {one.most_share for one in alone.corrections}) == (reason, {LEVEL_SHARE})
    result = calibrate(ledgers(rows), remembered=remembered_of(KNOWN))
    assert {one.most_share for one in result.corrections} == {ANY_SHARE}
    for name, error in ERRORS.items():
        assert result.machines[name].scale == pytest.approx(error.scale, abs=0.015)


def test_a_quarter_of_an_hour_in_which_nothing_is_shown_erases_nothing() -> None:
    decisions = CalibrationDecisions()
    level = Correction("a", EPOCH_NS, LAST_NS, 0.003, 0.0, 0.0, SURE, LEVEL_SHARE)
    for one in (KNOWN[0], level, replace(level, most_share=NO_SHARE)):
        decisions.add(CalibrationDecision("a", SOLVER, "", 0, (one,)))
        assert remembered_of(decisions.shown()) == remembered_of(KNOWN[:1])
    decisions.add(CalibrationDecision("a", SOLVER, "", 0, (replace(KNOWN[0], scale=0.1),), remembered=True))
    assert remembered_of(decisions.shown()) == remembered_of(KNOWN[:1])
    decisions.add(CalibrationDecision("a", SOLVER, "", 0, (replace(KNOWN[0], scale=0.1),)))
    assert remembered_of(decisions.shown())["a"].scale == pytest.approx(0.1 / 0.9)


def test_only_scales_that_were_observed_are_remembered() -> None:
    assert remembered_of([replace(KNOWN[0], most_share=share) for share in (LEVEL_SHARE, NO_SHARE)]) == {}
    prior = remembered_of(KNOWN)["a"]
    assert (prior.zero, prior.scale) == pytest.approx((0.0, 0.2))
    assert np.sqrt(np.diag(prior.covariance)) == pytest.approx([ZERO_STD, REMEMBERED_STD])
    far = Correction("a", 0, 1, 0.0, 0.375, 0.0, ((1e-7, 0, 0), (0, 0.04, 0), (0, 0, 1e-7)))
    assert remembered_of([far])["a"].covariance[1][1] == pytest.approx(0.04)
    assert REMEMBERED_STD < SCALE_STD / 2, "it counts as observed"


def applied(rows: Table, zero: Floats | float) -> Table:
    """Sent by a machine that takes off this zero."""
    out = rows.copy()
    out["c_rr"] -= np.sign(rows["speed_mps"]) * zero
    out["grade_e"] += zero * np.cos(rows["heading_rad"])
    out["grade_n"] += zero * np.sin(rows["heading_rad"])
    out["applied_zero"] = zero
    return out


def decided(rows: Mapping[str, Table]) -> CalibrationDecisions:
    solved, decisions = calibrate(ledgers(rows)), CalibrationDecisions()
    for i in range(3):
        for decision in decisions.judge(solved, START_NS + i * EVERY_NS):
            decisions.add(decision)
    return decisions


def test_a_machine_that_applied_nonsense_is_corrected_though_its_sensor_is_good() -> None:
    true = drive(LOW, Errors(), seconds=900.0)
    corrections = decided({"a": applied(true, 0.02)}).corrections
    right = corrections.applied(applied(true, 0.02), ["a"], np.zeros(len(true), np.int64))
    firm = true["c_rr"] < 0.07  # with an unknown scale, samples of large shares stay unchanged
    assert abs(np.mean((right["c_rr"] - true["c_rr"])[firm])) < 0.001
    assert decided({"a": true}).corrections.each == ()


def test_a_machine_that_changes_its_mind_within_an_epoch_is_corrected() -> None:
    rows = drive(LOW, Errors(0.012), seconds=900.0)
    to_and_fro = 0.012 + 0.006 * np.where(np.arange(len(rows)) // 100 % 2, 1.0, -1.0)
    table = ledgers({"a": applied(rows, to_and_fro)})["a"]
    for each in stated(table).values():
        assert (each.zero, each.zero_std) == pytest.approx((0.012, 0.006), abs=0.001)
        assert (each.scale, each.scale_std) == (0.0, 0.0)
    assert decided({"a": applied(rows, to_and_fro)}).corrections.each != ()


@pytest.mark.parametrize("errors", [Errors(11 * ZERO_STD), Errors(-6 * ZERO_STD), Errors(0.0, 15 * SCALE_STD)])
def test_of_two_machines_that_contradict_each_other_none_is_corrected(errors: Errors) -> None:
    rows = {
        name: drive(OPEN, own, seconds=200.0, closed=False, seed=i)
        for i, (name, own) in enumerate({"good": Errors(), "bad": errors}.items())
    }
    result = calibrate(ledgers(rows))
    for state in result.machines.values():
        assert (state.zero, state.scale) == pytest.approx((0.0, 0.0), abs=0.001)
        assert (state.zero_by, state.scale_by) == ((), ())
        assert max(state.beyond[0] / 5.0, state.beyond[1] / 6.7) < 1, "and nobody is accused"
