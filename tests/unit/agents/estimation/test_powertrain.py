"""Drive force of engine and motor: known answers, unknown cases."""

import math
from collections.abc import Sequence
from dataclasses import replace

import pytest

from agents.estimation import powertrain
from agents.estimation.powertrain import RETARDER_STD, DriveReadings, engine_drive, gear_ratio, motor_force, power_drive
from protocol.machine.machine_config import MachineConfig, SensorConfig
from protocol.machine.powertrain_config import PowertrainConfig
from protocol.machine.readings import (
    Driveline,
    Encoder,
    Engine,
    EngineLosses,
    HydraulicPressure,
    Motor,
    MotorPower,
    Reading,
    Retarder,
    Torque,
)
from tests.unit.agents.drives import Ground, Leg, drive, machine
from tests.unit.agents.ground import EstimatorRun

TRAIN = PowertrainConfig(
    reference_torque_nm=2000.0,
    losses=0.1,
    gears=(6.0, 3.0, 1.5),
    reverse_gears=(5.0,),
    final_drive=8.0,
    efficiency=0.9,
)
RADIUS_M = 0.75
SECOND_RADPS = 24.0 * 2.0 / RADIUS_M  # engine speed, second gear, 2 m/s
SENSORS = SensorConfig("engine", "engine"), SensorConfig("gearbox", "driveline")


def test_engine_torque_less_losses_arrives_by_gear_final_drive_and_efficiency() -> None:
    drive = engine_drive(TRAIN, 0.4, SECOND_RADPS, 2.0, RADIUS_M)
    assert drive.force_n == pytest.approx(0.4 * 2000 * 3 * 8 * 0.9 / 0.75)  # 23 040 N
    assert drive.variance_n2 == pytest.approx(2 * (0.01 * 2000 * 24 / 0.75) ** 2 / 12), "steps of torque and losses"
    assert drive.unknown == ""


def test_wheels_that_drive_the_engine_give_it_its_drag_and_the_losses() -> None:
    assert engine_drive(TRAIN, -0.1, SECOND_RADPS, 2.0, RADIUS_M).force_n == pytest.approx(-200 * 24 / 0.9 / 0.75)


def test_in_reverse_the_force_points_back() -> None:
    drive = engine_drive(TRAIN, 0.4, 40.0 * 2.0 / RADIUS_M, -2.0, RADIUS_M)
    assert drive.force_n == pytest.approx(-0.4 * 2000 * 40 * 0.9 / 0.75)


@pytest.mark.parametrize(
    ("engine_radps", "wheel_radps", "ratio"),
    [(24.0, 1.0, 24.0), (25.5, 1.0, 24.0), (22.6, 1.0, 24.0), (40.0, -1.0, -40.0), (12.0, 1.0, 12.0)],
)
def test_speeds_show_the_gear(engine_radps: float, wheel_radps: float, ratio: float) -> None:
    assert gear_ratio(TRAIN, engine_radps, wheel_radps) == ratio


@pytest.mark.parametrize(("engine_radps", "wheel_radps"), [(34.0, 1.0), (24.0, 0.0), (0.0, 1.0), (24.0, -1.0)])
def test_speeds_between_gears_show_none(engine_radps: float, wheel_radps: float) -> None:
    assert gear_ratio(TRAIN, engine_radps, wheel_radps) == 0.0


def test_a_motor_drives_by_its_ratio_or_by_power_over_speed() -> None:
    electric = PowertrainConfig(gears=(1.0,), final_drive=30.0, efficiency=0.9)
    assert motor_force(electric, 500.0, 3.0) == pytest.approx(500 * 30 * 0.9)
    assert motor_force(electric, -500.0, 3.0) == pytest.approx(-500 * 30 / 0.9)  # braking
    assert motor_force(electric, -500.0, -3.0) == pytest.approx(-500 * 30 * 0.9)  # driving back
    assert power_drive(electric, 60_000.0, 3.0).force_n == pytest.approx(18_000)
    assert power_drive(electric, 60_000.0, -3.0).force_n == pytest.approx(-18_000)
    assert power_drive(electric, 60_000.0, 0.4).unknown == "creeps"


def collected_by(train: PowertrainConfig, readings: Sequence[Reading]) -> DriveReadings:
    collected = DriveReadings(MachineConfig("m", wheel_radius_m=RADIUS_M, powertrain=train))
    assert all(map(collected.add, readings))
    return collected


def taken(*readings: Reading, train: PowertrainConfig = TRAIN) -> powertrain.Drive:
    return collected_by(train, readings).take(2.0)


ENGINE = Engine("engine", 10**9, 0.5, SECOND_RADPS)
LOADER = replace(TRAIN, idle_pressure_pa=3e6)


@pytest.mark.parametrize(
    ("beside", "train", "unknown"),
    [
        (Driveline("d", 10**9, 1, 1, 0), TRAIN, ""),
        (Driveline("d", 10**9, 0, 1, 0), TRAIN, "clutch"),
        (Driveline("d", 10**9, 1, 0, 0), TRAIN, "converter"),
        (Driveline("d", 10**9, 1, 1, 1), TRAIN, "gear_change"),
        (Engine("engine", 10**9, 0.5, 1.4 * SECOND_RADPS), TRAIN, "no_gear"),
        (EngineLosses("l", 10**9, 0.1), LOADER, "hydraulics"),  # pressure unknown
        (HydraulicPressure("h", 10**9, 2e7), LOADER, "hydraulics"),
        (HydraulicPressure("h", 10**9, 2e6), LOADER, ""),
        (Retarder("r", 10**9, 0.01), TRAIN, "braking"),  # nobody says how much that is
        (Retarder("r", 10**9, 0.0), TRAIN, ""),
        (Retarder("r", 10**9, 0.4), replace(TRAIN, retarder_torque_nm=1500.0), ""),
    ],
)
def test_a_force_that_is_not_known_has_a_reason(beside: Reading, train: PowertrainConfig, unknown: str) -> None:
    assert taken(ENGINE, beside, train=train).unknown == unknown


def test_losses_that_are_read_count_in_place_of_those_stated_and_not_once_they_fall_silent() -> None:
    stated, read = taken(ENGINE), taken(EngineLosses("l", 10**9, 0.2), ENGINE)
    assert read.force_n == pytest.approx(stated.force_n * 0.3 / 0.4)
    assert taken(EngineLosses("l", 1, 0.2), replace(ENGINE, stamp_ns=3 * 10**9)) == stated


@pytest.mark.parametrize("speed_mps", [2.0, -2.0])
def test_a_retarder_brakes_by_the_final_drive_and_leaves_doubt_in_proportion(speed_mps: float) -> None:
    train, retarder = replace(TRAIN, retarder_torque_nm=1500.0), Retarder("r", 10**9, 0.4)
    radps = SECOND_RADPS if speed_mps > 0 else 40.0 * 2.0 / RADIUS_M
    own, without = (
        collected_by(train, (*more, replace(ENGINE, speed_radps=radps))).take(speed_mps) for more in ((retarder,), ())
    )
    force_n = 0.4 * 1500 * 8 / 0.75  # 6400 N, whatever the gear
    assert without.force_n - own.force_n == pytest.approx(math.copysign(force_n, speed_mps))
    assert own.variance_n2 - without.variance_n2 == pytest.approx(
        (RETARDER_STD * force_n) ** 2 + (0.01 * force_n / 0.4) ** 2 / 12
    )


def test_torque_at_the_wheels_counts_before_what_a_motor_or_engine_states() -> None:
    wheels = Torque("t", 10**9, 3000.0)
    assert taken(ENGINE, wheels, ENGINE) == taken(wheels) == powertrain.Drive(3000.0 / RADIUS_M)
    assert taken(Retarder("r", 10**9, 0.4), wheels) == taken(wheels), "it is before the wheels"
    assert taken(MotorPower("p", 1, 1e4), Motor("m", 2, 100.0)).force_n == pytest.approx(100 * 48 * 0.9 / RADIUS_M)


def by_engine(readings: Sequence[Reading], gear: float = 24.0) -> list[Reading]:
    """The drive as reported by an engine: torque steps 1 %, speed steps 1/8 rpm."""
    made: list[Reading] = []
    ticks = [r for r in readings if isinstance(r, Encoder)]
    speeds = {
        b.stamp_ns // 50_000_000: (b.left_ticks - a.left_ticks) / 100 * math.tau / (b.stamp_ns - a.stamp_ns) * 1e9
        for a, b in zip(ticks[:-4], ticks[4:], strict=True)
    }
    for reading in readings:
        if not isinstance(reading, Torque):
            made.append(reading)
            continue
        radps = gear * speeds.get(reading.stamp_ns // 50_000_000, 0.0)
        net = reading.torque_nm / gear / TRAIN.reference_torque_nm
        share = round((net / TRAIN.efficiency if net > 0 else net * TRAIN.efficiency) + TRAIN.losses, 2)
        made.append(Engine("engine", reading.stamp_ns, share, round(radps / 0.0131) * 0.0131))
    return made


def test_an_engine_s_torque_in_steps_shows_the_ground_and_states_the_doubt_of_its_steps() -> None:
    vehicle = machine(powertrain=TRAIN)
    vehicle = replace(vehicle, sensors=(*vehicle.sensors, *SENSORS))
    legs = [Leg(2), *(Leg(2, 0.1 * sign) for sign in (1, 1, 1, -1, 1, -1) * 2)]
    made = drive(legs, vehicle, ground=Ground(0.04)).readings
    exact, stepped = EstimatorRun(vehicle).feed(made).last, EstimatorRun(vehicle).feed(by_engine(made)).last
    assert exact.c_rr == pytest.approx(0.04, abs=0.002)
    assert stepped.c_rr == pytest.approx(exact.c_rr, abs=2 * math.sqrt(stepped.c_rr_var))
    assert stepped.c_rr_var > exact.c_rr_var


def test_a_gear_change_is_a_reason_until_forces_have_settled() -> None:
    vehicle = machine(powertrain=TRAIN)
    vehicle = replace(vehicle, sensors=(*vehicle.sensors, *SENSORS))
    made = by_engine(drive([Leg(2), Leg(4, 0.5), Leg(8)], vehicle, ground=Ground(0.04)).readings)
    start_ns = made[0].stamp_ns
    changes = [Driveline("gearbox", start_ns + round(s * 1e9), 1, 1, float(9 < s < 10)) for s in range(1, 14)]
    changes += [Driveline("gearbox", start_ns + round(s * 1e8), 1, 1, 1) for s in range(90, 100)]
    readings = sorted([*made, *changes], key=lambda reading: reading.stamp_ns)
    run = EstimatorRun(vehicle).feed(readings)
    assert {e.reason for e in run.between(9.2, 9.9)} == {"gear_change"}
    assert {e.reason for e in run.between(10.2, 10.4)} == {"gear_change"}
    assert {e.reason for e in run.between(11, 13)} == {""}


@pytest.mark.parametrize(
    ("kind", "train", "problem"),
    [
        ("engine", None, "powertrain: engine: of no use without this table"),
        ("engine", PowertrainConfig(), "powertrain: engine: reference_torque_nm: an engine states its torque"),
        ("motor", PowertrainConfig(gears=(1.0, 2.0)), "powertrain: motor: gears: a motor states no speed"),
    ],
)
def test_a_powertrain_that_lacks_something_is_refused(kind: str, train: PowertrainConfig | None, problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        MachineConfig("m", powertrain=train, sensors=(SensorConfig("s", kind),))
