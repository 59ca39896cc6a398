"""Machines rolling unlike others: soft tyres, dragging brakes, lies; and lookalikes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from mapserver.calibration.calibrate import Solution, calibrate
from mapserver.calibration.correction import LAST_NS, Correction, corrected
from mapserver.calibration.decide import differs
from mapserver.calibration.decision import SOLVER, CalibrationDecision
from mapserver.calibration.select import Rolling, state_of
from mapserver.trust.auditor import Auditor
from protocol.arrays import Floats, Table
from protocol.units import DIESEL_J_PER_L
from tests.reference.correction import in_numpy
from tests.unit.mapserver.calibration.drives import LOW, RAMP, RAMP_AGAIN, Errors, Site, drive, ledgers, soils

FLEET = {
    "low": (LOW, Errors(0.004, -0.05, 0.002)),
    "ramp": (RAMP, Errors(-0.006, 0.04, -0.003)),
    "again": (RAMP_AGAIN, Errors(0.008, 0.03, 0.0)),
    "odd": (RAMP, Errors(0.002, -0.02, 0.001)),
}
SECONDS = 900.0  # three epochs


@cache
def driven(name: str, errors: Errors | None = None) -> Table:
    route, own = FLEET[name]
    return drive(route, errors or own, seconds=SECONDS, seed=[*FLEET].index(name))


def rolling(rows: Table, share: float, drag: float = 0.0) -> Table:
    """Of a machine that rolls harder, or says so; its slopes are right."""
    out = rows.copy()
    out["c_rr"] += share * rows["c_rr"] + drag
    return out


@cache
def solved(*odd: tuple[str, float, float]) -> tuple[Solution, Mapping[str, Table]]:
    """Solve and corrected samples of the fleet, with these machines rolling harder by a share and a drag."""
    harder = {name: (share, drag) for name, share, drag in odd}
    rows = {name: rolling(driven(name), *harder.get(name, (0.0, 0.0))) for name in FLEET}
    result = calibrate(ledgers(rows))
    return result, {n: corrected(t, [c for c in result.corrections if c.machine == n]) for n, t in rows.items()}


def unlike(result: Solution) -> dict[str, bool]:
    """Machines reported as rolling unlike others, and whether they are named."""
    return {name: state.rolling.is_named for name, state in result.machines.items() if state.rolling}


@pytest.mark.slow
@pytest.mark.parametrize(("name", "share", "drag"), [("odd", 0.25, 0.0), ("again", -0.25, 0.0), ("odd", 0.0, 0.012)])
def test_one_that_rolls_unlike_the_others_is_named_and_moves_nobody(name: str, share: float, drag: float) -> None:
    (honest, before), (result, after) = solved(), solved((name, share, drag))
    assert unlike(honest) == {}
    assert unlike(result) == {name: True}
    finding = result.machines[name].rolling
    assert finding is not None
    ground = np.average(before[name]["c_rr"], weights=1 / (0.004 + 0.08 * before[name]["c_rr"]) ** 2)
    assert abs(finding.share - share - drag / ground) < max(2 * finding.std, 0.06)
    assert 0.02 <= finding.std < 0.06
    for other in FLEET:
        was, now = honest.machines[other], result.machines[other]
        assert abs(now.scale - was.scale) <= was.scale_std, other
        assert now.zero == pytest.approx(was.zero, abs=2 * was.zero_std), other
        ratio = after[other]["c_rr"] / np.maximum(before[other]["c_rr"], 0.01)
        assert np.median(ratio) == pytest.approx(1.0, abs=0.02 + 0.02 * (other == name)), other
    assert result.machines["low"].scale_std > honest.machines["low"].scale_std, "what does not fit shows less"


@pytest.mark.slow
def test_a_torque_scale_is_none_on_slopes_and_stays_what_it_was_on_the_level() -> None:
    for name, errors in (("odd", Errors(0.002, 0.25, 0.001)), ("low", Errors(0.004, 0.25, 0.002))):
        result = calibrate(ledgers({other: driven(other, errors if other == name else None) for other in FLEET}))
        assert unlike(result) == ({"low": True} if name == "low" else {}), "where nothing tells, it may be its tyres"
        assert result.machines[name].scale == pytest.approx(0.25, abs=0.06)
        assert {(each.rolls, each.drags) for each in result.corrections} == {(0.0, 0.0)}


@pytest.mark.slow
def test_against_most_that_lie_alike_the_honest_one_is_odd_and_of_two_nobody_is_named() -> None:
    lie = ("low", 0.25, 0.0), ("ramp", 0.25, 0.0), ("again", 0.25, 0.0)
    result, _ = solved(*lie)
    easier = result.machines["odd"].rolling
    assert easier is not None
    assert easier.share < -0.1
    assert all(state.rolling is None or state.rolling.share > 0.1 for n, state in result.machines.items() if n != "odd")
    two = calibrate(ledgers({"ramp": driven("ramp"), "odd": rolling(driven("odd"), 0.3)}))
    alone = calibrate(ledgers({"ramp": driven("ramp"), "odd": driven("odd")}))
    assert unlike(two) == {"ramp": False, "odd": False}
    assert {(each.rolls, each.drags) for each in two.corrections} == {(0.0, 0.0)}
    for name, state in two.machines.items():
        assert abs(state.scale - alone.machines[name].scale) <= state.scale_std, name
        assert state.scale_std >= alone.machines[name].scale_std, name


@pytest.mark.slow
def test_rain_between_machines_is_nobody_s_tyres() -> None:
    """One drives before it and for five minutes after it: too short."""
    wet: Site = lambda x, y, h: 1.3 * soils(x, y, h)  # noqa: E731
    late: dict[str, Floats | float] = {"start_s": SECONDS}
    rows = {
        name: drive(FLEET[name][0], FLEET[name][1], seconds=SECONDS, site=wet, seed=i, **late)  # type: ignore[arg-type]
        for i, name in enumerate(("again", "ramp"))
    }
    after = drive(RAMP, FLEET["odd"][1], seconds=300.0, site=wet, seed=9, start_s=SECONDS)
    rows["odd"] = np.concatenate([driven("odd"), after])
    assert unlike(calibrate(ledgers(rows))) == {}


def test_machines_answers_have_it_with_its_diesel_where_the_mass_is_known() -> None:
    rows, auditor = driven("odd").copy(), Auditor(1.0)
    rows["mass_kg"] = 17_500.0
    auditor.add("odd", rows)
    state = state_of(Correction("odd", 0, LAST_NS, 0.0, 0.0, 0.0, ((1e-6, 0, 0), (0, 1e-4, 0), (0, 0, 1e-6))))
    said = auditor.verdicts({"odd": replace(state, rolling=Rolling(0.25, 0.06, True, 0.6))})["odd"]
    assert [said.evidence[name] for name in ("rolls", "rolls_std", "rolls_named")] == [0.25, 0.06, True]
    litres_ph = 0.6 * 17_500 * 3600 / (0.35 * DIESEL_J_PER_L)
    assert said.evidence["rolls_litres_ph"] == pytest.approx(litres_ph, abs=1e-4)
    assert not said.contradicts


def test_a_correction_undoes_it_bit_for_bit_and_an_event_keeps_it() -> None:
    honest, one = driven("odd", Errors()), Correction("odd", 0, LAST_NS, 0.0, 0.0, 0.0, ((1.0,),), 100.0, 0.25, 0.002)
    rows = rolling(honest, 0.25, 0.002)
    right = corrected(rows, [one])
    assert right.tobytes() == in_numpy(rows, one).tobytes()
    np.testing.assert_allclose(right["c_rr"], honest["c_rr"], atol=1e-6)
    body = CalibrationDecision("odd", SOLVER, "", 1, (one, replace(one, rolls=0.0, drags=0.0))).body()
    assert CalibrationDecision.from_body(body).corrections[0] == one
    assert [len(span) for span in body["spans"]] == [9, 7], "events of machines that roll alike are as they were"
    sure = replace(one, covariance=((1e-6, 0.0, 0.0), (0.0, 1e-5, 0.0), (0.0, 0.0, 1e-6)))
    assert differs(sure, replace(sure, rolls=0.0, drags=0.0))
    assert not differs(sure, replace(sure, rolls=0.24))
