"""The whole ground estimator on synthetic drives: from readings to resistance and slope."""

import math
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from agents.estimation.calibration import Calibration
from agents.estimation.ground import ESTIMATORS, NOTHING_KNOWN, EstimationConfig, GroundEstimate
from agents.estimation.tuning import TUNING
from protocol.machine.machine_config import MachineConfig, SensorConfig
from protocol.machine.readings import Imu, Reading, Torque
from protocol.machine.samples import SCALE_STD, ZERO_STD
from protocol.units import GRAVITY_MPS2
from tests.unit.agents.drives import START_NS, VEHICLE, Drive, Ground, Leg, drive, machine, noisy, thinned
from tests.unit.agents.ground import EstimatorRun

SLOPE_RAD = math.radians(15)
STAND, START = Leg(2), Leg(4, 0.5)
FORWARDS = [STAND, START, Leg(10)]
REVERSE = [STAND, Leg(4, -0.5), Leg(10)]
PLACE_ALONE = replace(NOTHING_KNOWN, mass_kg=VEHICLE.mass_kg)
STOP, BACK = Leg(4, -0.5), Leg(4, -0.5)


def last_estimate(vehicle: MachineConfig, made: Drive | list[Reading], **options: Any) -> GroundEstimate:
    readings = made.readings if isinstance(made, Drive) else made
    return EstimatorRun(vehicle, EstimationConfig(**options)).feed(readings).last


def weighing(**options: Any) -> MachineConfig:
    vehicle = machine(**options)
    return replace(vehicle, sensors=(*vehicle.sensors, SensorConfig("scale", "payload")))


@pytest.mark.slow
@pytest.mark.parametrize(("legs", "c_rr", "ahead_rad"), [(FORWARDS, 0.25, SLOPE_RAD), (REVERSE, 0.05, -SLOPE_RAD)])
def test_resistance_and_slope_are_right(legs: list[Leg], c_rr: float, ahead_rad: float) -> None:
    """Positive slope is uphill ahead, in reverse too."""
    made = drive(legs, VEHICLE, ground=Ground(c_rr, ahead_rad))
    for estimator in ESTIMATORS:
        estimate = last_estimate(VEHICLE, made, estimator=estimator)
        assert estimate.c_rr == pytest.approx(c_rr, abs=0.003), estimator
        assert estimate.slope_x == pytest.approx(math.tan(ahead_rad), abs=0.005), estimator
        assert estimate.slope_y == pytest.approx(0.0, abs=0.002), estimator
        assert estimate.reason == "", estimator


@pytest.mark.parametrize(("mass", "stated_kg"), [("message", 22_500.0), ("known", 17_500.0), ("estimated", math.nan)])
def test_estimates_state_the_mass_as_it_is_weighed(mass: str, stated_kg: float) -> None:
    vehicle = weighing()
    made = drive([replace(leg, payload_kg=5000) for leg in FORWARDS], vehicle, ground=Ground(0.06, 0.1))
    estimate = last_estimate(vehicle, made, mass=mass)
    assert estimate.mass_kg == pytest.approx(stated_kg, nan_ok=True)
    if mass != "estimated":
        wrong = 5 / 17.5 * (0.06 + math.tan(0.1)) if mass == "known" else 0.0
        assert estimate.c_rr == pytest.approx(0.06 + wrong, abs=0.005)


def test_the_first_step_answers_for_itself_and_a_moment_before() -> None:
    """Of two steps around a stamp the nearest one answers; none beyond 0.2 s."""
    run = EstimatorRun(VEHICLE).feed(drive([STAND, START], VEHICLE).readings)
    begin_ns, after_ns = (judged.stamp_ns for judged in list(run.estimator._judged)[:2])
    judged = [run.estimator._nearest(begin_ns + ns) for ns in (-200_000_001, -200_000_000, 0, 1)]
    assert [one and one.stamp_ns for one in judged] == [None, begin_ns, begin_ns, begin_ns]
    nearer = run.estimator._nearest(after_ns - 1)
    assert nearer
    assert nearer.stamp_ns == after_ns


# --- uncertainty -----------------------------------------------------------------------------------------------------


def test_variance_has_its_parts() -> None:
    """Filter, model, zero and scale."""
    made = drive(FORWARDS, VEHICLE)
    base = last_estimate(VEHICLE, made).c_rr_var
    for zero_std, scale_std, more in (
        (0.02, SCALE_STD, 0.02**2 - 0.0045**2),
        (ZERO_STD, 0.5, (0.5**2 - 0.045**2) * 0.04**2),
    ):
        vague = Calibration(0.0, 0.0, ((zero_std**2, 0.0), (0.0, scale_std**2)))
        run = EstimatorRun(VEHICLE, EstimationConfig(), calibration=vague).feed(made.readings)
        assert run.last.c_rr_var - base == pytest.approx(more, rel=1e-3)
    run = EstimatorRun(VEHICLE, tuning=replace(TUNING, model_std=0.01)).feed(made.readings)
    assert run.last.c_rr_var - base == pytest.approx(0.01**2 - 0.0015**2)


@pytest.mark.slow
@pytest.mark.parametrize("estimator", ["kalman", pytest.param("rls", marks=pytest.mark.nightly)])
def test_normalised_errors_are_about_one(estimator: str) -> None:
    """Uncalibrated machines on a slope with errors of the assumed size."""
    vehicle, errors = machine(), []
    legs = [STAND, START, Leg(6), Leg(3, 0.2), Leg(3, -0.2), Leg(4)]
    made = {ahead: thinned(drive(legs, vehicle, ground=Ground(0.05, ahead)).readings, 20) for ahead in (0.0, 0.1)}
    for seed in range(6):
        rng = np.random.default_rng(100 + seed)
        zero, scale = ZERO_STD * GRAVITY_MPS2 * rng.standard_normal(), 1 + SCALE_STD * rng.standard_normal()
        readings = noisy(made[0.1 * (seed % 2)], seed, torque=scale, force_mps2=zero)
        for estimate in (
            EstimatorRun(vehicle, EstimationConfig(estimator=estimator)).feed(readings).between(8, 20)[::10]
        ):
            assert not estimate.reason
            errors.append((estimate.c_rr - 0.05) / math.sqrt(estimate.c_rr_var))
    rms = float(np.sqrt(np.mean(np.square(errors))))
    assert 0.5 < rms < 1.5, rms


# --- unknown ---------------------------------------------------------------------------------------------------------


def test_standing_machine_learns_nothing_and_keeps_what_it_knew() -> None:
    legs = [*FORWARDS, Leg(4, -0.5), Leg(5), Leg(2, 0.6), Leg(2)]
    run = EstimatorRun(VEHICLE).feed(drive(legs, VEHICLE, ground=Ground(0.2)).readings)
    standing = run.between(21, 24)
    assert {e.reason for e in standing} == {"standstill"}
    assert all(math.isnan(e.c_rr) and e.slope_x == pytest.approx(0.0, abs=0.005) for e in standing)
    again = [e.c_rr for e in run.between(26.5, 30) if not e.reason]
    assert again
    assert np.abs(np.array(again) - 0.2).max() < 0.006


def test_an_estimate_belongs_to_its_stamp_and_to_none_else() -> None:
    run = EstimatorRun(VEHICLE).feed(drive(FORWARDS, VEHICLE).readings)
    newest = run.estimator.newest_ns
    assert not run.estimator.at(newest).reason
    assert run.estimator.at(newest + 250_000_000) == PLACE_ALONE
    assert run.estimator.at(newest - 25 * 10**9) == PLACE_ALONE  # forgotten
    assert run.estimator.at(newest - 3 * 10**9).c_rr == pytest.approx(0.04, abs=0.003)


def test_change_of_slope_blurs_slope_and_resistance() -> None:
    made = drive([*FORWARDS, Leg(5)], VEHICLE).readings
    turning = [
        replace(r, gyro_y_radps=-0.05) if isinstance(r, Imu) and 0 < r.stamp_ns - START_NS - 10 * 10**9 < 10**9 else r
        for r in made
    ]
    estimates = EstimatorRun(VEHICLE).feed(turning).between(10.2, 10.8)
    assert {e.reason for e in estimates} == {"pitch_transient"}
    for e in estimates:
        assert np.isnan([e.c_rr, e.c_rr_var, e.slope_x, e.slope_y, e.slope_var]).all()
        assert e.mass_kg == VEHICLE.mass_kg


# --- calibration -----------------------------------------------------------------------------------------------------

CYCLE = [Leg(4, 0.5), Leg(6), Leg(4, -0.5), Leg(4), Leg(4, -0.5), Leg(6), Leg(4, 0.5), Leg(4)]  # there and back


@cache
def cycles(vehicle: MachineConfig, n: int, **ground: Any) -> list[Reading]:
    return thinned(drive([STAND, *CYCLE * n], vehicle, ground=Ground(0.04, **ground)).readings)


def off(readings: list[Reading], zero_mps2: float, torque: float = 1.0) -> list[Reading]:
    """With accelerometer and torque errors."""
    return [
        replace(r, force_x_mps2=r.force_x_mps2 + zero_mps2)
        if isinstance(r, Imu)
        else replace(r, torque_nm=r.torque_nm * torque)
        if isinstance(r, Torque)
        else r
        for r in readings
    ]


@pytest.mark.slow
def test_zero_is_found_by_the_work_cycle() -> None:
    """0.06 m/s2 are 0.006 of c_rr, opposite by direction; the slope is corrected too."""
    readings = off(cycles(VEHICLE, 3), 0.06)
    run, without = (EstimatorRun(VEHICLE, EstimationConfig(calibrate=c)).feed(readings) for c in (True, False))
    for direction in ((79.5, 83.5), (97.5, 101.5)):  # of the last cycle
        calibrated, uncalibrated = ([e.c_rr for e in r.between(*direction) if not e.reason] for r in (run, without))
        assert len(calibrated) > 20
        assert np.mean(calibrated) == pytest.approx(0.04, abs=0.0015)
        assert abs(np.mean(uncalibrated) - 0.04) == pytest.approx(0.06 / GRAVITY_MPS2, abs=0.001)
    health = run.estimator.health()["calibration"]
    assert health["zero"] == pytest.approx(-0.06 / GRAVITY_MPS2, abs=0.001)
    assert 0 < health["zero_std"] < 0.0015
    assert health["pairs"] > 60
    assert health["passages"] >= health["pairs"]
    assert 0 <= health["age_s"] < 40
    assert run.last.slope_x == pytest.approx(0.0, abs=0.003)
    assert without.last.slope_x == pytest.approx(0.06 / GRAVITY_MPS2, abs=0.003)
    assert run.last.slope_var < without.last.slope_var


@pytest.mark.slow
def test_new_calibration_takes_effect_at_a_standstill_only() -> None:
    made = drive([STAND, START, Leg(24), Leg(4, -0.5), Leg(3), START, Leg(6)], VEHICLE).readings
    run = EstimatorRun(VEHICLE, known_c_rr=0.04).feed(off(made, 0.06))
    first = [e.c_rr for e in run.between(8, 29) if not e.reason]
    assert np.mean(first) == pytest.approx(0.04 - 0.06 / GRAVITY_MPS2, abs=1e-3)
    assert np.ptp(first) < 2e-3
    assert run.estimator.calibration.passages > 60
    health = run.estimator.health()["calibration"]
    assert health["zero"] == pytest.approx(-0.06 / GRAVITY_MPS2, abs=0.0015)
    assert health["known_ground"] > 60


@pytest.mark.slow
def test_each_estimate_states_the_calibration_that_it_was_made_with() -> None:
    """Taking it out gives the estimate of an uncalibrated machine."""
    readings = off(cycles(VEHICLE, 3, ahead_rad=0.1), -0.06, torque=1.04)
    runs = [EstimatorRun(VEHICLE, EstimationConfig(calibrate=each)).feed(readings) for each in (True, False)]
    assert len({own.zero for _, own in runs[0].estimates}) > 2  # changes during the drive
    for direction, *span in ((1, 79.5, 83.5), (-1, 97.5, 101.5)):
        pairs = list(zip(*(run.between(*span) for run in runs), strict=True))
        assert len(pairs) > 30
        for own, plain in pairs:
            share = (direction * own.c_rr + own.slope_x) / (1 - own.scale)
            assert own.c_rr + direction * (own.zero + own.scale * share) == pytest.approx(plain.c_rr, abs=2e-3)
            assert abs(own.c_rr - plain.c_rr) > 5e-3
            assert own.slope_x == pytest.approx(math.tan(math.atan(plain.slope_x) + own.zero), abs=1e-12)
            assert (plain.zero, plain.scale) == (0.0, 0.0)


@pytest.mark.nightly
@pytest.mark.slow
def test_a_jolt_on_the_way_does_not_hide_the_zero() -> None:
    """Three steps at the limit of plausibility, as at a ramp's foot."""
    made = off(thinned(drive([STAND, START, Leg(80, turn_radps=0.1)], VEHICLE).readings), 0.06)
    jolt_ns = range(START_NS + 40_000_000_000, START_NS + 40_150_000_000)
    readings = [replace(r, force_z_mps2=17.0) if isinstance(r, Imu) and r.stamp_ns in jolt_ns else r for r in made]
    run = EstimatorRun(VEHICLE, EstimationConfig(), knows_place=True).feed(readings)
    health = run.estimator.health()["calibration"]
    assert "accelerometer" in [e.reason for e in run.between(39, 42)]
    assert (health["tours"], health["torn"]) == (1, 0)
    assert health["zero"] == pytest.approx(-0.06 / GRAVITY_MPS2, abs=0.0015)  # from one tour and the data sheet
    plain = EstimatorRun(VEHICLE, EstimationConfig(closed_tours=False), knows_place=True).feed(readings)
    assert plain.estimator.health()["calibration"]["zero"] == 0.0
