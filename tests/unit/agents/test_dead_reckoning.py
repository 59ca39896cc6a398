import math
from dataclasses import replace

import numpy as np
import pytest

from agents.dead_reckoning import DeadReckoning, WheelTracker
from protocol.machine.machine_config import MachineConfig, Mount, SensorConfig
from protocol.machine.readings import Encoder, Imu, Odometry, Steering, Torque
from protocol.units import GRAVITY_MPS2
from tests.unit.agents.drives import START_NS, VEHICLE, Leg, drive, machine, reckoned

DOUBLE = replace(VEHICLE, sensors=(*VEHICLE.sensors, SensorConfig("imu-2", "imu"), SensorConfig("wheels-2", "encoder")))


def test_tracker_equals_least_squares_of_a_parabola_with_fading_weights() -> None:
    seed, dt, tau_s = 2, 0.05, 0.15
    rng = np.random.default_rng(seed)
    t = np.arange(1, 400) * dt
    travel = 3 * t + np.sin(t) + 0.02 * rng.standard_normal(len(t))
    tracker = WheelTracker(tau_s)
    for seconds, metres in zip(t, travel, strict=True):
        tracker.update(START_NS + round(seconds * 1e9), metres)
    weights = np.exp(-0.5 * (t[-1] - t) / tau_s)  # polyfit squares them
    half_accel, speed, _ = np.polyfit(t - t[-1], travel, 2, w=weights)
    assert tracker.speed_mps == pytest.approx(speed, abs=1e-6), f"seed={seed}"
    assert tracker.accel_mps2 == pytest.approx(2 * half_accel, abs=1e-5), f"seed={seed}"


@pytest.mark.parametrize("rate_hz", [5, 100])
def test_tracker_starts_in_motion_with_the_first_readings(rate_hz: int) -> None:
    """A parabola is tracked from the third reading, whatever preceded a pause."""
    tracker = WheelTracker()
    tracker.update(START_NS - 10**10, 900.0, speed_mps=-7.0)
    for i in range(2 * rate_hz):
        t = i / rate_hz
        tracker.update(START_NS + round(t * 1e9), 30.0 + 4.0 * t + 0.4 * t**2)
        if i >= 2:
            assert tracker.speed_mps == pytest.approx(4.0 + 0.8 * t, abs=1e-5)
            assert tracker.accel_mps2 == pytest.approx(0.8, abs=1e-3)
    assert tracker.is_settled


def test_tracker_forgets_in_a_pause_and_ignores_time_that_stands_still() -> None:
    tracker = WheelTracker()
    for i in range(1, 100):
        tracker.update(START_NS + i * 50_000_000, 0.1 * i)
    speed = tracker.speed_mps
    tracker.update(START_NS + 99 * 50_000_000, 50.0)
    assert (tracker.speed_mps, tracker.is_settled) == (speed, True)
    tracker.update(START_NS + 10**10, 50.0)
    assert (tracker.speed_mps, tracker.accel_mps2, tracker.is_settled) == (0.0, 0.0, False)


def test_dead_reckoning_closes_a_circle() -> None:
    vehicle = machine(Mount((0.4, 0.2, 0.9), (20.0, -35.0, 110.0)))
    made = drive([Leg(5, 0.6), Leg(2 * math.pi / 0.2, 0.0, 0.2)], vehicle, heading_rad=0.0, without=("gps-1",))
    reckoning = reckoned(vehicle, made.readings)
    turned = reckoning.pose
    start = made.at(START_NS + 5_000_000_000)  # start of the circle
    assert turned.angle_rad == pytest.approx(2 * math.pi, abs=0.01)
    assert turned.travel_m == pytest.approx(reckoning.distance_m)
    assert (turned.x_m, turned.y_m) == pytest.approx((start[0] - 10, start[1] - 20), abs=0.3)


def test_odometry_is_integrated_over_time_and_a_pause_counts_one_second_at_most() -> None:
    sensor = SensorConfig("odom", "odometry")
    reckoning = DeadReckoning(MachineConfig("cart", sensors=(sensor,)), 0.2)
    for i in range(1, 101):
        reckoning.update(Odometry("odom", START_NS + i * 100_000_000, 2.0, 0.0, 0.0), sensor)
    assert reckoning.travel_m == pytest.approx(2.0 * 9.9)
    reckoning.update(Odometry("odom", START_NS + 14 * 10**9, 2.0, 0.0, 0.0), sensor)
    assert reckoning.travel_m == pytest.approx(2.0 * 10.9)


@pytest.mark.parametrize(("direction", "traction"), [(1, 0.1), (-1, -0.1), (1, -0.1), (1, 1.5)])
def test_slip_is_taken_off_where_torque_drives_and_added_where_it_brakes(direction: int, traction: float) -> None:
    """Drive force a tenth of the weight, slip 0.2 per traction: 2 % of the distance.

    Beyond the whole weight it is a wrong unit and ignored.
    """
    wheels, torque = VEHICLE.sensor("wheels"), VEHICLE.sensor("torque")
    reckoning = DeadReckoning(VEHICLE, slip=0.2)
    force_n = traction * VEHICLE.mass_kg * GRAVITY_MPS2
    traction = traction if traction < 1 else 0.0
    lost = 0.2 * traction * direction
    reckoning.update(Torque("torque", START_NS, force_n * VEHICLE.wheel_radius_m), torque)
    for i in range(101):
        reckoning.update(Encoder("wheels", START_NS + i * 50_000_000, i * direction, i * direction), wheels)
    rolled_m = 2 * math.pi * VEHICLE.wheel_radius_m
    assert reckoning.travel_m == pytest.approx(direction * (1 - lost) * rolled_m)
    assert reckoning.distance_m == pytest.approx((1 - lost) * rolled_m)
    assert reckoning.traction == pytest.approx(traction)
    now = reckoning.pose
    assert (now.stamp_ns, now.travel_m, now.x_m) == (START_NS + 5 * 10**9, reckoning.travel_m, reckoning.travel_m)


def test_several_sensors_of_a_kind_count_as_their_mean_and_one_that_dies_leaves_the_other() -> None:
    """Second gyro off by 0.02 rad/s, second wheels by 10 %; both fall silent after 6 s."""
    silent_ns, readings = START_NS + 6 * 10**9, []
    for r in drive([Leg(4, 0.5), Leg(8)], DOUBLE).readings:
        if r.sensor == "imu-2":
            r = replace(r, gyro_z_radps=r.gyro_z_radps + 0.02)
        elif r.sensor == "wheels-2":
            r = replace(r, left_ticks=1.1 * r.left_ticks, right_ticks=1.1 * r.right_ticks)
        readings += [] if r.stamp_ns > silent_ns and r.sensor.endswith("-2") else [r]
    reckoning = reckoned(DOUBLE, readings)
    assert reckoning.angle_rad == pytest.approx(0.01 * 6, rel=0.02)
    assert reckoning.travel_m == pytest.approx(1.05 * 8 + 12 - 1.0, abs=0.2)  # half a second of travel waits for them
    assert reckoning.wheels.speed_mps == pytest.approx(2.0)


def test_wheels_that_speak_again_do_not_count_what_others_counted() -> None:
    pause_ns = START_NS + 5 * 10**9, START_NS + 9 * 10**9
    made = drive([Leg(4, 0.5), Leg(8)], DOUBLE).readings
    readings = [r for r in made if r.sensor != "wheels-2" or not pause_ns[0] < r.stamp_ns < pause_ns[1]]
    assert reckoned(DOUBLE, readings).travel_m == pytest.approx(20.0, abs=2.1)
    assert reckoned(DOUBLE, readings).wheels.speed_mps == pytest.approx(2.0)


@pytest.mark.parametrize("offset_m", [-0.76, 0.0, 0.76])
@pytest.mark.parametrize("turn", ["imu", "steering"])
def test_a_wheel_off_the_middle_of_its_axle_shows_the_way_of_the_middle(offset_m: float, turn: str) -> None:
    """In a left bend of 8 m, a wheel 0.76 m left of the centre rolls a tenth less."""
    wheels = SensorConfig("wheels", "odometry", Mount((0.0, offset_m, 0.0)), measures=("speed",))
    vehicle = MachineConfig("truck", wheelbase_m=2.5, sensors=(wheels, SensorConfig("turn", turn)))
    speed, rate, readings = 2.0, 0.25, []
    for i in range(101):
        stamp_ns = START_NS + i * 50_000_000
        turned = Imu("turn", stamp_ns, 0, 0, rate, 0, 0, 9.81) if turn == "imu" else None
        readings.append(turned or Steering("turn", stamp_ns, math.atan(2.5 * rate / speed)))
        readings.append(Odometry("wheels", stamp_ns, speed - rate * offset_m, 0.0, 0.0))
    reckoning = reckoned(vehicle, readings)
    assert reckoning.travel_m == pytest.approx(10.0)
    assert reckoning.angle_rad == pytest.approx(1.25)
    ahead, left = 8 * math.sin(1.25), 8 * (1 - math.cos(1.25))
    assert (reckoning.pose.x_m, reckoning.pose.y_m) == pytest.approx((ahead, left), abs=0.01)
    assert (reckoning.wheels.speed_mps, reckoning.wheels.offset_m) == pytest.approx((speed - rate * offset_m, offset_m))


def test_restarted_tick_counter_moves_nothing() -> None:
    made = drive([Leg(4, 0.5), Leg(6)], VEHICLE)
    restart_ns = START_NS + 6 * 10**9
    readings = [
        replace(r, left_ticks=r.left_ticks - 1e6, right_ticks=r.right_ticks - 1e6)
        if isinstance(r, Encoder) and r.stamp_ns > restart_ns
        else r
        for r in made.readings
    ]
    before, after = reckoned(VEHICLE, made.readings), reckoned(VEHICLE, readings)
    assert after.travel_m == pytest.approx(before.travel_m, abs=0.15)  # travel between two counts
    assert after.distance_m == pytest.approx(before.distance_m, abs=0.15)
    assert after.wheels.speed_mps == pytest.approx(before.wheels.speed_mps, abs=0.1)
