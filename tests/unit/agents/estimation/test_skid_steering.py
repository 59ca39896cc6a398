"""Skid steering: stated, detected, and only apparent."""

from collections.abc import Iterable, Iterator
from dataclasses import replace

import pytest

from agents.dead_reckoning import DeadReckoning
from agents.estimation.skid_steering import SkidSteering
from protocol.machine.machine_config import MachineConfig, SensorConfig, machine_toml
from protocol.machine.readings import Encoder, Imu, Odometry, Reading
from protocol.units import GRAVITY_MPS2
from tests.unit.agents.drives import START_NS, Ground, Leg, drive, machine
from tests.unit.agents.ground import EstimatorRun

TICK_RAD = 0.0628  # 100 ticks a turn
TURNS = [Leg(2), Leg(4, 0.5), Leg(10), Leg(10, 0.0, 0.2), Leg(10)]
ROBOT = machine(wheelbase_m=3.3)
BY_ODOMETRY = replace(ROBOT, sensors=(ROBOT.sensors[0], SensorConfig("wheels", "odometry")))


def readings(vehicle: MachineConfig, motions: Iterable[tuple[float, float, float]]) -> Iterator[Reading]:
    """From seconds, mid speed of the wheels [m/s], turn rate by gyro and by wheels [rad/s]; track 2 m."""
    stamp_ns, left, right = START_NS, 0.0, 0.0
    for seconds, speed, rate in motions:
        for _ in range(round(seconds / 0.05)):
            stamp_ns += 50_000_000
            left, right = left + 0.05 * (speed - rate), right + 0.05 * (speed + rate)
            yield Imu("imu", stamp_ns, 0.0, 0.0, rate, 0.0, 0.0, GRAVITY_MPS2)
            if vehicle is BY_ODOMETRY:
                yield Odometry("wheels", stamp_ns, speed, 0.0, rate)
            else:
                yield Encoder("wheels", stamp_ns, left // (0.75 * TICK_RAD), right // (0.75 * TICK_RAD))


def seen(vehicle: MachineConfig, made: Iterable[Reading]) -> bool:
    dead_reckoning, steering = DeadReckoning(vehicle, 0.0), SkidSteering(vehicle)
    for reading in made:
        sensor = vehicle.sensor(reading.sensor)
        assert sensor
        dead_reckoning.update(reading, sensor)
        steering.update(reading, sensor, dead_reckoning)
    return steering.is_so


@pytest.mark.parametrize("vehicle", [ROBOT, BY_ODOMETRY], ids=["encoder", "odometry"])
@pytest.mark.parametrize(
    ("motions", "skids"),
    [
        ([(10, 1.0, 0.0), (6, 0.0, 0.4)], True),  # turns on the spot
        ([(10, 1.0, 0.0), (6, 0.0, -0.4)], True),
        ([(60, 1.0, 0.3)], False),  # a bend of 3 m
        ([(3, 0.0, 0.2), (3, 0.0, -0.2)] * 9, False),  # standing articulation to and fro
        ([(60, 0.0, 0.0)], False),
    ],
)
def test_a_machine_that_turns_on_the_spot_skid_steers(vehicle: MachineConfig, motions: list, skids: bool) -> None:
    assert seen(vehicle, readings(vehicle, motions)) == skids
    assert not seen(replace(vehicle, skid_steers=False), readings(vehicle, motions))


def test_a_wheel_of_the_wrong_sign_and_a_machine_that_is_carried_are_no_skid_steering() -> None:
    """One seems to turn on the spot and does not; the other turns with standing wheels."""
    straight = [
        replace(r, left_ticks=-r.left_ticks) if isinstance(r, Encoder) else r for r in readings(ROBOT, [(30, 1, 0)])
    ]
    assert not seen(ROBOT, straight)
    carried = [
        replace(r, left_ticks=0, right_ticks=0) if isinstance(r, Encoder) else r for r in readings(ROBOT, [(30, 0, 1)])
    ]
    assert not seen(ROBOT, carried)


@pytest.mark.parametrize("skids", [True, None])
def test_turns_of_a_machine_that_skid_steers_are_without_resistance(skids: bool | None) -> None:
    vehicle = machine(wheelbase_m=3.3, load_centre_m=1.65, skid_steers=skids)
    run = EstimatorRun(vehicle).feed(drive(TURNS, vehicle, ground=Ground(0.05)).readings)
    assert {e.reason for e in run.between(18, 25)} == ({"skid_turn"} if skids else {""})
    assert {e.reason for e in run.between(10, 15)} == {e.reason for e in run.between(29, 34)} == {""}
    assert all(e.slope_x == pytest.approx(0.0, abs=0.01) for e in run.between(18, 25))
    assert run.estimator.health()["skid_steers"] is bool(skids)


def test_whether_it_skid_steers_is_written_only_where_it_is_stated() -> None:
    assert "skid_steers" not in machine_toml(ROBOT)
    assert "skid_steers = true" in machine_toml(replace(ROBOT, skid_steers=True))
