"""Force balances from readings: drive force less the rest is direction c_rr cos(slope)."""

import math
from dataclasses import replace

import pytest

from agents.estimation.balance import squat_rad
from protocol.machine.machine_config import FRONT, MachineConfig, Mount, SensorConfig
from protocol.machine.readings import Encoder, Gps, Imu, Torque
from protocol.units import GRAVITY_MPS2
from tests.unit.agents.drives import START_NS, VEHICLE, Drive, Ground, Leg, changed_sensor, drive, machine
from tests.unit.agents.ground import balances

FORWARDS = [Leg(2), Leg(4, 0.5), Leg(10)]
REVERSE = [Leg(2), Leg(4, -0.5), Leg(10)]
BODY = {"wheelbase_m": 3.3, "axle_stiffness_npm": 1.8e6, "cog_height_m": 1.05, "payload_x_m": 4.7, "payload_z_m": 0.85}


def loader(mount: Mount | None = None, **options: float) -> MachineConfig:
    """An articulated machine on tyres that weighs its load."""
    vehicle = machine(mount, **{**BODY, **options})  # type: ignore[arg-type]
    more = SensorConfig("joint", "articulation"), SensorConfig("scale", "payload")
    return replace(vehicle, sensors=(*vehicle.sensors, *more))


@pytest.mark.parametrize("legs", [FORWARDS, REVERSE], ids=["forwards", "reverse"])
@pytest.mark.parametrize(("c_rr", "ahead_deg"), [(0.008, 0.0), (0.25, 15.0)])
def test_what_is_left_is_the_rolling_resistance(legs: list[Leg], c_rr: float, ahead_deg: float) -> None:
    last = balances(VEHICLE, drive(legs, VEHICLE, ground=Ground(c_rr, math.radians(ahead_deg))).readings)[-1]
    direction = 1.0 if legs is FORWARDS else -1.0
    assert last.direction == direction
    assert last.unbalanced == pytest.approx(direction * c_rr * math.cos(math.radians(ahead_deg)), abs=1e-4)
    assert last.share == pytest.approx(last.unbalanced + math.sin(math.radians(ahead_deg)), abs=1e-4)
    assert last.slope_x == pytest.approx(math.radians(ahead_deg), abs=3e-3)
    assert last.sine_x == pytest.approx(math.sin(math.radians(ahead_deg)), abs=3e-3)
    assert last.speed_mps == pytest.approx(direction * 2.0, abs=0.02)


def test_a_load_does_not_rotate() -> None:
    """By hand: rotating mass 0.2 of 17.5 t equals 0.1 of 35 t."""
    vehicle, rigid = (loader(rotating_mass_factor=factor, axle_stiffness_npm=0.0) for factor in (1.2, 1.0))
    made = drive([Leg(2, payload_kg=17_500), Leg(8, 0.5, payload_kg=17_500)], vehicle).readings
    assert balances(vehicle, made)[-1].unbalanced == pytest.approx(0.04, abs=1e-3)
    assert balances(rigid, made)[-1].unbalanced == pytest.approx(0.04 + 0.1 * 0.5 / GRAVITY_MPS2, abs=1e-3)


def test_mounting_is_turned_back() -> None:
    vehicle = machine(Mount((0.4, 0.0, 0.9), (10.0, -20.0, 30.0)))
    last = balances(vehicle, drive(FORWARDS, vehicle, ground=Ground(0.05, 0.2, 0.1)).readings)[-1]
    assert last.unbalanced == pytest.approx(0.05 * math.cos(0.2), abs=1e-4)
    assert (last.slope_x, last.slope_y) == pytest.approx((0.2, 0.1), abs=3e-3)


def test_lever_arm_of_the_accelerometer_in_a_bend_is_taken_off() -> None:
    """2.5 m ahead of the rear axle, 0.4 rad/s pulls 0.4 m/s2 backwards: 0.04 of c_rr."""
    vehicle = machine(Mount((2.5, 0.0, 0.9)))
    legs = [Leg(2), Leg(4, 0.5), Leg(6, 0.0, 0.4)]
    made = drive(legs, vehicle)
    measured = [r for r in made.readings if isinstance(r, Imu)][-1]
    assert measured.force_x_mps2 == pytest.approx(-0.4)
    last = balances(vehicle, made.readings)[-1]
    assert last.unbalanced == pytest.approx(0.04, abs=1e-3)
    assert last.slope_x == pytest.approx(0.0, abs=2e-3)
    moved = balances(changed_sensor(vehicle, "imu", mount=Mount()), made.readings)[-1]
    assert moved.unbalanced == pytest.approx(0.04 + 0.4 / GRAVITY_MPS2, abs=1e-3)


def test_turning_across_a_slope_keeps_slopes_and_resistance_right() -> None:
    """With a fixed slope the force share would be off by up to g sin(15 deg)."""
    ground = Ground(0.04, left_rad=math.radians(15))
    legs = [Leg(2), Leg(4, 0.5), Leg(4), Leg(12, 0.0, 0.25)]
    for at in balances(VEHICLE, drive(legs, VEHICLE, ground=ground).readings)[160:]:
        turned = max((at.stamp_ns - START_NS) * 1e-9 - 10, 0) * 0.25
        here = ground.turned(turned)
        assert (at.slope_x, at.slope_y) == pytest.approx((here.ahead_rad, here.left_rad), abs=0.01)
        assert at.unbalanced == pytest.approx(0.04 * math.cos(here.ahead_rad), abs=2e-3)


def test_bent_machine_on_a_side_slope_climbs_with_its_front_axle() -> None:
    """By hand: the front axle carries 1.5 / 3.3 of the weight and climbs by sin(0.2) sin(bend)."""
    vehicle, bend_rad = loader(axle_stiffness_npm=0.0, cog_height_m=0.0), -0.5
    legs = [Leg(2), Leg(4, 0.5, bend_rad=bend_rad), Leg(6, bend_rad=bend_rad)]
    made = drive(legs, vehicle, ground=Ground(0.04, 0.0, 0.2)).readings
    extra = 1.5 / 3.3 * math.sin(0.2) * math.sin(bend_rad)
    last = balances(vehicle, made)[-1]
    assert last.share == pytest.approx(0.04 + extra, abs=1e-4)
    assert last.unbalanced == pytest.approx(0.04, abs=1e-3)
    straight = balances(vehicle, [r for r in made if r.sensor != "joint"])[-1]  # no joint sensor
    assert straight.unbalanced == pytest.approx(0.04 + extra, abs=1e-3)


@pytest.mark.parametrize(
    ("legs", "on_front", "share"), [(FORWARDS, 1.5 / 3.3, -0.5 + 1.5 / 3.3), (REVERSE, 0.7, 0.2)], ids=["ahead", "back"]
)
def test_axles_on_a_curve_stand_on_two_slopes(legs: list[Leg], on_front: float, share: float) -> None:
    """By hand: 0.01 rad/m over 3.3 m; the front axle is on the steeper half of a concave curve."""
    vehicle = loader(axle_stiffness_npm=0.0, cog_height_m=0.0, load_centre_m=3.3 * on_front)
    made = drive(legs, vehicle, ground=Ground(0.04)).readings
    speed_mps = 2.0 if legs is FORWARDS else -2.0
    concave = [replace(r, gyro_y_radps=-0.01 * speed_mps) if isinstance(r, Imu) else r for r in made]
    level, curved = (balances(vehicle, readings)[-1] for readings in (made, concave))
    assert level.unbalanced - curved.unbalanced == pytest.approx(share * 3.3 * 0.01, rel=0.02)


def test_payload_counts_as_mass_and_moves_weight_to_the_front() -> None:
    vehicle = loader()
    legs = [Leg(2), Leg(4, 0.5, payload_kg=4000, bend_rad=0.4), Leg(6, payload_kg=4000, bend_rad=0.4)]
    made = drive(legs, vehicle, ground=Ground(0.04, 0.0, 0.15)).readings
    weighed, not_weighed = (balances(vehicle, made, weighs=weighs)[-1] for weighs in (True, False))
    assert weighed.unbalanced == pytest.approx(0.04, abs=2e-3)
    assert not_weighed.share == pytest.approx(weighed.share * 21.5 / 17.5)
    assert abs(not_weighed.unbalanced - 0.04) > 0.01


@pytest.mark.parametrize(("payload_kg", "accel_mps2"), [(0.0, 0.8), (4000.0, 0.8)])
def test_squat_is_no_slope_and_no_resistance(payload_kg: float, accel_mps2: float) -> None:
    """A full bucket lowers the nose by 0.9 degrees: 0.015 of c_rr and slope, uncorrected."""
    vehicle = loader()
    legs = [Leg(2), Leg(4, 0.5, payload_kg=payload_kg), Leg(12, accel_mps2, payload_kg=payload_kg)]
    made = drive(legs, vehicle, ground=Ground(0.04, 0.1)).readings
    last = balances(vehicle, made)[-1]
    assert last.unbalanced == pytest.approx(0.04 * math.cos(0.1), abs=1e-3)
    assert last.slope_x == pytest.approx(0.1, abs=3e-3)
    assert last.sine_x == pytest.approx(math.sin(0.1), abs=3e-3)
    rigid = balances(replace(vehicle, axle_stiffness_npm=0.0), made)[-1]
    assert (abs(rigid.slope_x - 0.1) > 5e-3) == bool(payload_kg)


def test_torque_between_two_steps_is_averaged_and_the_last_one_kept() -> None:
    made = [r for r in drive(FORWARDS, VEHICLE).readings if not isinstance(r, Torque)]
    wheel_nm = VEHICLE.mass_kg * GRAVITY_MPS2 * VEHICLE.wheel_radius_m
    stamps = [r.stamp_ns for r in made if isinstance(r, Imu)]
    stated = {stamps[500 + i]: wheel_nm * 0.01 * i for i in range(1, 6)}
    torques = [Torque("torque", stamp, nm) for stamp, nm in stated.items()]
    steps = balances(VEHICLE, sorted([*torques, *made], key=lambda r: r.stamp_ns))
    share = {b.stamp_ns: b for b in steps}
    first = next(b for b in steps if b.torque_s < math.inf)
    assert first.stamp_ns <= stamps[505]
    shares = [b.share for b in steps if b.torque_s < math.inf]
    assert 0.01 <= shares[0] <= 0.05
    assert shares[-1] == pytest.approx(0.05)  # the last one, kept
    assert share[steps[-1].stamp_ns].torque_s == pytest.approx((steps[-1].stamp_ns - stamps[505]) * 1e-9)
    assert steps[0].torque_s == math.inf


def test_ages_of_wheels_and_torque_and_silent_wheels_that_stand() -> None:
    made = drive(FORWARDS, VEHICLE)
    cut = made.stamps_ns[700]
    silent = [r for r in made.readings if not isinstance(r, Encoder | Torque | Gps) or r.stamp_ns <= cut]
    steps = balances(VEHICLE, silent)
    last = steps[-1]
    assert last.wheels_s == pytest.approx((last.stamp_ns - cut) * 1e-9, abs=0.06)
    assert last.torque_s == pytest.approx((last.stamp_ns - cut) * 1e-9, abs=0.02)
    assert (last.speed_mps, last.accel_mps2) == (0.0, 0.0)
    never = balances(VEHICLE, [r for r in made.readings if isinstance(r, Imu)])[-1]
    assert (never.wheels_s, never.torque_s) == (math.inf, math.inf)


@pytest.mark.parametrize(
    "options", [{"frame": FRONT}, {"measures": ("rate",)}], ids=["front frame", "no accelerometer"]
)
def test_only_an_accelerometer_on_the_rear_frame_counts(options: dict[str, object]) -> None:
    made: Drive = drive(FORWARDS, VEHICLE)
    assert balances(changed_sensor(VEHICLE, "imu", **options), made.readings) == []
    assert balances(VEHICLE, made.readings)


def test_pause_of_the_imu_spoils_no_step() -> None:
    made = drive(FORWARDS, VEHICLE)
    silent = (made.stamps_ns[600], made.stamps_ns[750])
    steps = balances(
        VEHICLE, [r for r in made.readings if not (isinstance(r, Imu) and silent[0] < r.stamp_ns < silent[1])]
    )
    assert max(b.dt_s for b in steps) < 0.07
    assert not [b for b in steps if silent[0] < b.stamp_ns < silent[1]]
    assert steps[-1].unbalanced == pytest.approx(0.04, abs=1e-3)


# --- squat ------------------------------------------------------------------------------------------------------------

LOADER = MachineConfig("loader-1", **{**BODY, "wheelbase_m": 3.0, "cog_height_m": 1.0})


@pytest.mark.parametrize("unknown", ["wheelbase_m", "axle_stiffness_npm"])
def test_without_data_there_is_no_squat_and_none_at_rest_or_beyond_gravity(unknown: str) -> None:
    assert squat_rad(replace(LOADER, **{unknown: 0.0}), 4000, 2.0) == 0.0  # type: ignore[arg-type]
    assert squat_rad(LOADER, 0.0, 0.0) == 0.0
    assert math.isfinite(squat_rad(LOADER, 4000, 30.0))


def test_payload_ahead_of_the_front_axle_lowers_the_nose() -> None:
    """By hand: 4000 kg at 4.7 m load the front axle by 61.5 kN, the rear by -22.2 kN."""
    front_n, rear_n = 4000 * GRAVITY_MPS2 * 4.7 / 3.0, 4000 * GRAVITY_MPS2 * (1 - 4.7 / 3.0)
    assert (front_n, rear_n) == pytest.approx((61_455, -22_228), abs=1)
    assert squat_rad(LOADER, 4000, 0.0) == pytest.approx((rear_n - front_n) / (1.8e6 * 3.0))
    assert squat_rad(LOADER, 4000, 0.0) == pytest.approx(-0.015497, abs=1e-6)
