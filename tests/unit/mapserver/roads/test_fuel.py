"""Burned litres on segments against those predicted by resistance, slope, mass and speed."""

from __future__ import annotations

import numpy as np
import pytest

from mapserver.evidence.fold_config import name_hash
from mapserver.roads.fuel import BURNED_SHARE, ROTATING, Litres, litres_of
from mapserver.roads.ledger import Ledgers
from mapserver.roads.loss import losses
from mapserver.roads.tally import Tally
from protocol.arrays import Floats, Table
from protocol.units import DIESEL_J_PER_L, GRAVITY_MPS2
from tests.unit.mapserver.roads.drives import STEP_M, along, passes, roads

PER_J, PER_H = 1 / (0.4 * DIESEL_J_PER_L), 6.0  # litres per marginal work and per hour
LINE = along([(10, 20), (310, 20)])


def driven(*, slope: float = 0.0, back: bool = False, accel_mps2: float = 0.0, fuel: bool = True) -> Table:
    """Passes over good, then bad ground; fuel by Willans' line."""
    rows = passes(LINE[::-1] if back else LINE, 6, 0.02)
    rows["c_rr"] = np.where(rows["x_m"] < 160, 0.02, 0.06)
    rows["grade_e"], rows["grade_n"], rows["grade_var"] = np.where(rows["x_m"] < 160, slope, 0.0), 0.0, 1e-4
    along_m = np.abs(rows["x_m"] - (310 if back else 10))
    rows["speed_mps"] = np.sqrt(25.0 + 2 * accel_mps2 * along_m)
    rise = rows["grade_e"] * (-1 if back else 1)
    force = rows["mass_kg"] * (GRAVITY_MPS2 * (rows["c_rr"] + rise) + ROTATING * accel_mps2)
    hours = STEP_M / rows["speed_mps"] / 3600
    rows["fuel_l"] = np.maximum(PER_J * force * STEP_M + PER_H * hours, 0.0) if fuel else np.nan
    return rows


def burning(rows: Table, per_hour: float, accel_mps2: Floats | float = 0.0) -> Table:
    """The same drive with fuel by work and by time."""
    force = rows["mass_kg"] * (GRAVITY_MPS2 * rows["c_rr"] + ROTATING * accel_mps2)
    rows["fuel_l"] = np.maximum(PER_J * force * STEP_M + per_hour * STEP_M / rows["speed_mps"] / 3600, 0.0)
    return rows


def litres(*machines: Table) -> Litres | None:
    kept = Tally()
    for i, rows in enumerate(machines):
        kept.add(rows, np.full(len(rows), name_hash(f"truck-{i}"), np.uint64))
    segments = roads(*machines)
    ledger = Ledgers(segments).ledger(kept.table(), kept.slot_ns)
    return litres_of(ledger, segments, losses(ledger, segments, 0.02))


@pytest.mark.parametrize("slope", [0.0, 0.03, -0.05])
@pytest.mark.parametrize("accel_mps2", [0.0, 0.05])
def test_what_follows_resistance_slope_and_speed_is_predicted_as_burned(slope: float, accel_mps2: float) -> None:
    """Downhill too, with engines burning nothing, on segments of three times the burn."""
    machines = driven(slope=slope, accel_mps2=accel_mps2), driven(slope=slope, back=True)
    fuel = litres(*machines)
    assert fuel
    known = fuel.share > 0.5
    assert known.sum() >= 10
    assert fuel.burned.max() > 1.5 * fuel.burned[known].min()
    assert fuel.predicted[known] == pytest.approx(fuel.burned[known], rel=0.06)
    assert fuel.burned.sum() == pytest.approx(sum(rows["fuel_l"].sum() for rows in machines), rel=0.02)
    assert (fuel.low[known] <= fuel.predicted[known]).all()
    assert (fuel.high[known] >= fuel.predicted[known]).all()
    assert fuel.burned_std == pytest.approx(BURNED_SHARE * fuel.burned)


@pytest.mark.parametrize(("begin_m", "length_m"), [(95.0, 60.0), (105.0, 50.0), (120.0, 40.0)])
def test_a_machine_that_speeds_up_near_the_end_of_a_segment_is_predicted_as_burned(
    begin_m: float, length_m: float
) -> None:
    rows = passes(LINE, 6, 0.02)
    run_m = np.clip(rows["x_m"] - begin_m, 0.0, length_m)
    rows["speed_mps"] = np.sqrt(9.0 + 2 * 0.3 * run_m)
    fuel = litres(burning(rows, PER_H, np.where((run_m > 0) & (run_m < length_m), 0.3, 0.0)))
    assert fuel
    assert fuel.burned.max() > 2 * fuel.burned.min()
    assert fuel.predicted == pytest.approx(fuel.burned, rel=0.01)


def test_a_slow_loader_is_predicted_as_burned_beside_trucks_whose_engines_lose_more() -> None:
    """Four litres an hour at 2.5 m/s, eight at 8 m/s, on roads apart."""
    fleet = []
    for beside_m, mass_kg, speed_mps, per_hour in ((0.0, 40_000.0, 8.0, 8.0), (80.0, 17_000.0, 2.5, 4.0)):
        rows = passes(LINE + np.array([0.0, beside_m]), 6, mass_kg=mass_kg)
        rows["c_rr"], rows["speed_mps"] = np.where(rows["x_m"] < 160, 0.02, 0.06), speed_mps
        fleet.append(burning(rows, per_hour))
    fuel = litres(*fleet)
    assert fuel
    assert fuel.predicted == pytest.approx(fuel.burned, rel=0.02)


def test_ground_that_the_map_has_wrong_stands_out() -> None:
    """A segment burning a half more than its resistance is off by that, others hardly."""
    rows = driven()
    odd = (rows["x_m"] > 200) & (rows["x_m"] < 225)
    rows["fuel_l"][odd] *= 1.5
    fuel = litres(rows)
    assert fuel
    off = fuel.predicted / fuel.burned
    assert off.min() < 0.75
    assert np.median(off) == pytest.approx(1.0, abs=0.08)


def test_without_fuel_there_are_no_litres_and_the_share_is_that_of_the_driving() -> None:
    silent = driven(fuel=False)
    assert litres(silent) is None
    fuel = litres(driven(), silent)
    assert fuel
    assert fuel.share[fuel.burned > 0] == pytest.approx(0.5, abs=0.02)
