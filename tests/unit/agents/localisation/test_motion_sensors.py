"""What becomes of a filter step: which measurements, with which deviations and gates."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from agents.dead_reckoning import DeadReckonedPose, WheelSpeed
from agents.localisation import measurements
from agents.localisation.filters.state import YAW_RATE, Layout
from agents.localisation.headings import UNKNOWN_STD
from agents.localisation.imu_steps import FilterStep, ImuMean, Turn
from agents.localisation.motion_sensors import ROLLING_S, STANDSTILL_S, MotionSensors, rolling_resistance
from protocol.machine.machine_config import MachineConfig, SensorConfig
from protocol.units import GRAVITY_MPS2

STEP = FilterStep(7, DeadReckonedPose(7, 0.0, 0.0, 0.0, 0.0), {}, {}, WheelSpeed(2.0, is_known=True), True, 0.1, 0.0)
FORCE = np.array([0.06 * GRAVITY_MPS2, 0.0, GRAVITY_MPS2])
IMU_STEP = replace(STEP, imu_means={"imu": ImuMean(np.zeros(3), FORCE)})


def sensors(
    *configured: SensorConfig, slip: float = 0.0, slip_soft: float = 0.0, on_plane: bool = False
) -> MotionSensors:
    machine = MachineConfig("truck", wheelbase_m=3.0, sensors=configured)
    return MotionSensors(machine, Layout(imus=1, wheel_scale=True), 10.0, (slip, slip_soft), on_plane=on_plane)


def deviations(R: Any) -> list[float]:
    return np.sqrt(np.diag(R)).tolist()  # type: ignore[no-any-return]


@pytest.mark.parametrize(
    ("options", "rate", "force"),
    [
        ({}, measurements.RATE_RADPS, measurements.FORCE_MPS2),
        ({"std": {"rate": 0.1, "force": 0.5}}, 0.1, 0.5),
        ({"measures": ("rate",)}, measurements.RATE_RADPS, UNKNOWN_STD),
        ({"measures": ("force",)}, UNKNOWN_STD, measurements.FORCE_MPS2),
    ],
)
def test_an_imu_is_as_sure_as_it_is_configured(options: dict[str, Any], rate: float, force: float) -> None:
    imu = SensorConfig("imu", "imu", **options)
    (measurement,) = sensors(imu).inertial(IMU_STEP)
    assert deviations(measurement.R) == pytest.approx([rate] * 3 + [force] * 3)
    assert measurement.z[3:].tolist() == FORCE.tolist()
    assert len(sensors(imu).forces(IMU_STEP)) == ("measures" not in options or "force" in options["measures"])


def test_on_a_plane_an_imu_measures_the_turn_alone() -> None:
    step = replace(IMU_STEP, imu_means={"imu": ImuMean(np.array([0.3, -0.2, 0.1]), FORCE)})
    (measurement,) = sensors(SensorConfig("imu", "imu", std={"rate": 0.1}), on_plane=True).inertial(step)
    assert (measurement.sensor, measurement.z.tolist(), deviations(measurement.R)) == ("imu", [0.1], [0.1])
    assert measurement.jacobian(np.zeros(17))[0].nonzero()[0].tolist() == [YAW_RATE, Layout(imus=1).gyro_bias(0)]
    assert sensors(SensorConfig("imu", "imu", measures=("force",)), on_plane=True).inertial(step) == []


@pytest.mark.parametrize(("gate_sigma", "expected"), [(0.0, measurements.GATE_SIGMA), (2.5, 2.5)])
def test_each_sensor_may_have_its_own_gate(gate_sigma: float, expected: float) -> None:
    imu, wheels = (SensorConfig(kind, kind, gate_sigma=gate_sigma) for kind in ("imu", "encoder"))
    steering = SensorConfig("steering", "steering", gate_sigma=gate_sigma)
    body = sensors(wheels, steering)
    made = [*sensors(imu).inertial(IMU_STEP), *body.wheels(STEP), *body.turn(replace(STEP, turn=Turn(0.1, 2.0)))]
    assert [m.gate_sigma for m in made] == [expected] * 3


@pytest.mark.parametrize(
    ("slip", "slip_soft", "speed_mps"), [(0.0, 0.0, 2.0), (0.2, 0.0, 2.0 * 0.98), (0.2, 1.0, 2.0 * (1 - 0.1 * 0.24))]
)
def test_slip_of_the_tyres_and_of_soft_ground_is_taken_off(slip: float, slip_soft: float, speed_mps: float) -> None:
    """Traction of a tenth of the weight, of which 0.06 climb: 0.04 roll."""
    body = sensors(SensorConfig("imu", "imu"), SensorConfig("wheels", "encoder"), slip=slip, slip_soft=slip_soft)
    (wheels,) = body.wheels(IMU_STEP)
    assert wheels.z.tolist() == pytest.approx([speed_mps, 0.0, 0.0])


def test_wheels_that_are_silent_or_without_speed_measure_nothing() -> None:
    wheels = SensorConfig("wheels", "odometry")
    assert sensors(wheels).wheels(replace(STEP, rolled=False, still_s=9.0)) == []
    assert sensors(replace(wheels, measures=("rate",))).wheels(STEP) == []
    (measurement,) = sensors(replace(wheels, std={"speed": 0.5})).wheels(STEP)
    assert deviations(measurement.R) == pytest.approx([0.5, measurements.SIDE_MPS, measurements.SIDE_MPS])


def test_a_machine_stands_once_its_wheels_do_not_turn_for_a_second() -> None:
    body = sensors(SensorConfig("wheels", "encoder"))
    named = [[m.sensor for m in body.wheels(replace(STEP, still_s=s))] for s in (STANDSTILL_S - 0.1, STANDSTILL_S)]
    assert named == [["wheels"], ["wheels", "standstill"]]


def test_a_turn_without_any_source_is_counted() -> None:
    blind = sensors(SensorConfig("wheels", "encoder"))
    assert blind.turn(STEP) == []
    assert blind.counters == {"turn_unknown": 1}
    assert blind.turn_error_radps == 0.0
    stated = sensors(SensorConfig("odometry", "odometry", std={"rate": 0.3}))
    (turn,) = stated.turn(replace(STEP, turn=Turn(0.1, 1.0)))
    assert (deviations(turn.R), stated.turn_error_radps) == ([0.3], 0.3)
    assert not stated.counters


@pytest.mark.parametrize("dt_s", [0.01, 0.05])
def test_rolling_resistance_is_what_neither_climbs_nor_accelerates_and_follows_in_half_a_second(dt_s: float) -> None:
    rolling, seen = np.float64(0.0), []
    for _ in range(round(10 * ROLLING_S / dt_s)):
        rolling = rolling_resistance(rolling, 0.15, 0.12 * GRAVITY_MPS2, dt_s)
        seen.append(rolling)
    assert seen[round(ROLLING_S / dt_s) - 1] == pytest.approx(0.03 * (1 - np.exp(-1)), rel=0.1)
    assert seen[-1] == pytest.approx(0.03, rel=1e-3)
