"""Readings become balances of force: what is left of drive force is direction c_rr cos(slope)."""

import math
from dataclasses import replace

import numpy as np
import pytest

from agents.estimation.balance import front_share, squat_rad
from protocol.machine.machine_config import FRONT, MachineConfig, Mount, SensorConfig
from protocol.machine.readings import Encoder, Imu, Payload, Torque
from protocol.units import GRAVITY_MPS2
from tests.unit.agents.drives import START_NS, VEHICLE, Drive, Ground, Leg, changed_sensor, drive, machine
from tests.unit.agents.ground import balances

FORWARDS = [Leg(2), Leg(4, 0.5), Leg(10)]
REVERSE = [Leg(2), Leg(4, -0.5), Leg(10)]
BODY = {"wheelbase_m": 3.3, "axle_stiffness_npm": 1.8e6, "cog_height_m": 1.05, "payload_x_m": 4.7, "payload_z_m": 0.85}


def loader(mount: Mount | None = None, **options: float) -> MachineConfig:
    """A machine that bends, weighs what it carries, and sits on tyres."""
    vehicle = machine(mount, **{**BODY, **options})  # type: ignore[arg-type]
    more = SensorConfig("joint", "articulation"), SensorConfig("scale", "payload")
    return replace(vehicle, sensors=(*vehicle.sensors, *more))


@pytest.mark.parametrize("legs", [FORWARDS, REVERSE], ids=["forwards", "reverse"])
@pytest.mark.parametrize(("c_rr", "ahead_deg"), [(0.008, 0.0), (0.25, 15.0), (0.05, -15.0)])
def test_what_is_left_is_the_rolling_resistance(legs: list[Leg], c_rr: float, ahead_deg: float) -> None:
    last = balances(VEHICLE, drive(legs, VEHICLE, ground=Ground(c_rr, math.radians(ahead_deg))).readings)[-1]
    direction = 1.0 if legs is FORWARDS else -1.0
    assert last.direction == direction
    assert last.unbalanced == pytest.approx(direction * c_rr * math.cos(math.radians(ahead_deg)), abs=1e-4)
    assert last.share == pytest.approx(last.unbalanced + math.sin(math.radians(ahead_deg)), abs=1e-4)
    assert last.slope_x == pytest.approx(math.radians(ahead_deg), abs=3e-3)
    assert last.sine_x == pytest.approx(math.sin(math.radians(ahead_deg)), abs=3e-3)
    assert last.speed_mps == pytest.approx(direction * 2.0, abs=0.02)


def test_a_step_ends_every_50_ms() -> None:
    steps = balances(VEHICLE, drive(FORWARDS, VEHICLE).readings)
    assert [b.dt_s for b in steps] == pytest.approx([0.05] * 319)
    assert np.diff([b.stamp_ns for b in steps]).tolist() == [50_000_000] * 318


def test_rotating_mass_is_taken_off() -> None:
    """What the machine does not know of its wheels' inertia looks like ground."""
    vehicle, wrong = machine(rotating_mass_factor=1.2), machine(rotating_mass_factor=1.0)
    made = drive([Leg(10, 0.5)], vehicle).readings
    assert balances(vehicle, made)[-1].unbalanced == pytest.approx(0.04, abs=1e-3)
    assert balances(wrong, made)[-1].unbalanced == pytest.approx(0.04 + 0.2 * 0.5 / GRAVITY_MPS2, abs=1e-3)


def test_a_load_does_not_rotate() -> None:
    """By hand: wheels that weigh as much as 0.2 of 17.5 t weigh as much as 0.1 of 35 t."""
    vehicle, rigid = (loader(rotating_mass_factor=factor, axle_stiffness_npm=0.0) for factor in (1.2, 1.0))
    made = drive([Leg(2, payload_kg=17_500), Leg(8, 0.5, payload_kg=17_500)], vehicle).readings
    assert balances(vehicle, made)[-1].unbalanced == pytest.approx(0.04, abs=1e-3)
    assert balances(rigid, made)[-1].unbalanced == pytest.approx(0.04 + 0.1 * 0.5 / GRAVITY_MPS2, abs=1e-3)


@pytest.mark.parametrize("rpy_deg", [(180.0, 0.0, 0.0), (10.0, -20.0, 30.0)])
def test_mounting_is_turned_back(rpy_deg: tuple[float, float, float]) -> None:
    vehicle = machine(Mount((0.4, 0.0, 0.9), rpy_deg))
    last = balances(vehicle, drive(FORWARDS, vehicle, ground=Ground(0.05, 0.2, 0.1)).readings)[-1]
    assert last.unbalanced == pytest.approx(0.05 * math.cos(0.2), abs=1e-4)
    assert (last.slope_x, last.slope_y) == pytest.approx((0.2, 0.1), abs=3e-3)


def test_lever_arm_of_the_accelerometer_in_a_bend_is_taken_off() -> None:
    """2.5 m ahead of the rear axle a turn of 0.4 rad/s pulls 0.4 m/s2 backwards: 0.04 of c_rr."""
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


@pytest.mark.parametrize(("every", "worst"), [(1, 5e-3), (20, 0.01)], ids=["20 Hz", "1 Hz"])
def test_starting_and_stopping_is_no_slope_however_seldom_the_wheels_report(every: int, worst: float) -> None:
    made = drive([Leg(5), Leg(3, 1.0), Leg(5), Leg(3, -1.0), Leg(5, 0.0)], VEHICLE).readings
    wheels = [r for r in made if isinstance(r, Encoder)]
    left = [r for r in made if not isinstance(r, Encoder) or wheels.index(r) % every == 0]
    steps = balances(VEHICLE, left)
    assert max(abs(b.slope_x) for b in steps) < worst


def test_a_wheel_beside_the_middle_is_no_slope_in_a_bend() -> None:
    """One encoder 1 m to the left rolls 0.3 m/s less in a bend to the left of 0.3 rad/s."""
    vehicle = changed_sensor(VEHICLE, "wheels", mount=Mount((0.0, 1.0, 0.0)))
    made = drive([Leg(2), Leg(4, 0.5), Leg(6), Leg(6, 0.0, 0.3), Leg(6)], VEHICLE)
    heading = dict(zip(made.stamps_ns, (made.heading_rad - made.heading_rad[0]).tolist(), strict=True))
    ticks_per_m = VEHICLE.sensors[2].ticks_per_rev / (math.tau * VEHICLE.wheel_radius_m)

    def beside(encoder: Encoder) -> Encoder:
        ticks = encoder.left_ticks - round(heading[encoder.stamp_ns] * ticks_per_m)
        return replace(encoder, left_ticks=ticks, right_ticks=ticks)

    readings = [beside(r) if isinstance(r, Encoder) else r for r in made.readings]
    assert max(abs(b.slope_x) for b in balances(vehicle, readings)[100:]) < 6e-3


def test_turning_across_a_slope_keeps_slopes_and_resistance_right() -> None:
    """The wheels' share of the force is off by up to g sin(15 deg) if the slope does not turn with the machine."""
    ground = Ground(0.04, left_rad=math.radians(15))
    legs = [Leg(2), Leg(4, 0.5), Leg(4), Leg(12, 0.0, 0.25)]
    for at in balances(VEHICLE, drive(legs, VEHICLE, ground=ground).readings)[160:]:
        turned = max((at.stamp_ns - START_NS) * 1e-9 - 10, 0) * 0.25
        here = ground.turned(turned)
        assert (at.slope_x, at.slope_y) == pytest.approx((here.ahead_rad, here.left_rad), abs=0.01)
        assert at.unbalanced == pytest.approx(0.04 * math.cos(here.ahead_rad), abs=2e-3)


@pytest.mark.parametrize("bend_rad", [0.5, -0.5])
def test_bent_machine_on_a_side_slope_climbs_with_its_front_axle(bend_rad: float) -> None:
    """By hand: 1.5 / 3.3 of the weight stand on the front axle, whose way rises by sin(0.2) sin(bend)."""
    vehicle = loader(axle_stiffness_npm=0.0, cog_height_m=0.0)
    legs = [Leg(2), Leg(4, 0.5, bend_rad=bend_rad), Leg(6, bend_rad=bend_rad)]
    made = drive(legs, vehicle, ground=Ground(0.04, 0.0, 0.2)).readings
    extra = 1.5 / 3.3 * math.sin(0.2) * math.sin(bend_rad)
    last = balances(vehicle, made)[-1]
    assert last.share == pytest.approx(0.04 + extra, abs=1e-4)
    assert last.unbalanced == pytest.approx(0.04, abs=1e-3)
    straight = balances(vehicle, [r for r in made if r.sensor != "joint"])[-1]  # nobody says that it is bent
    assert straight.unbalanced == pytest.approx(0.04 + extra, abs=1e-3)


@pytest.mark.parametrize(
    ("legs", "on_front", "share"), [(FORWARDS, 1.5 / 3.3, -0.5 + 1.5 / 3.3), (REVERSE, 0.7, 0.2)], ids=["ahead", "back"]
)
def test_axles_on_a_curve_stand_on_two_slopes(legs: list[Leg], on_front: float, share: float) -> None:
    """By hand: 0.01 rad per metre over 3.3 m; the front axle's load is on its steeper half where it is concave."""
    vehicle = loader(axle_stiffness_npm=0.0, cog_height_m=0.0, load_centre_m=3.3 * on_front)
    made = drive(legs, vehicle, ground=Ground(0.04)).readings
    speed_mps = 2.0 if legs is FORWARDS else -2.0
    concave = [replace(r, gyro_y_radps=-0.01 * speed_mps) if isinstance(r, Imu) else r for r in made]
    level, curved = (balances(vehicle, readings)[-1] for readings in (made, concave))
    assert level.unbalanced - curved.unbalanced == pytest.approx(share * 3.3 * 0.01, rel=0.02)


def test_bent_machine_uphill_climbs_less() -> None:
    vehicle = loader(axle_stiffness_npm=0.0, cog_height_m=0.0)
    legs = [Leg(2), Leg(4, 0.5, bend_rad=0.6), Leg(6, bend_rad=0.6)]
    last = balances(vehicle, drive(legs, vehicle, ground=Ground(0.04, 0.2)).readings)[-1]
    assert last.share == pytest.approx(
        0.04 * math.cos(0.2) + math.sin(0.2) * (1 - 1.5 / 3.3 * (1 - math.cos(0.6))), abs=1e-4
    )
    assert last.unbalanced == pytest.approx(0.04 * math.cos(0.2), abs=1e-3)


def test_payload_counts_as_mass_and_moves_weight_to_the_front() -> None:
    vehicle = loader()
    legs = [Leg(2), Leg(4, 0.5, payload_kg=4000, bend_rad=0.4), Leg(6, payload_kg=4000, bend_rad=0.4)]
    made = drive(legs, vehicle, ground=Ground(0.04, 0.0, 0.15)).readings
    weighed, not_weighed = (balances(vehicle, made, weighs=weighs)[-1] for weighs in (True, False))
    assert weighed.unbalanced == pytest.approx(0.04, abs=2e-3)
    assert not_weighed.share == pytest.approx(weighed.share * 21.5 / 17.5)
    assert abs(not_weighed.unbalanced - 0.04) > 0.01


@pytest.mark.parametrize(("payload_kg", "accel_mps2"), [(0.0, 0.8), (4000.0, 0.0), (4000.0, 0.8)])
def test_squat_is_no_slope_and_no_resistance(payload_kg: float, accel_mps2: float) -> None:
    """A full bucket lowers the nose by 0.9 degrees, which would be 0.015 of c_rr and of slope."""
    vehicle = loader()
    legs = [Leg(2), Leg(4, 0.5, payload_kg=payload_kg), Leg(12, accel_mps2, payload_kg=payload_kg)]
    made = drive(legs, vehicle, ground=Ground(0.04, 0.1)).readings
    last = balances(vehicle, made)[-1]
    assert last.unbalanced == pytest.approx(0.04 * math.cos(0.1), abs=1e-3)
    assert last.slope_x == pytest.approx(0.1, abs=3e-3)
    assert last.sine_x == pytest.approx(math.sin(0.1), abs=3e-3)
    rigid = balances(replace(vehicle, axle_stiffness_npm=0.0), made)[-1]
    assert (abs(rigid.slope_x - 0.1) > 5e-3) == bool(payload_kg)


def test_nose_that_rises_is_a_positive_pitch_rate() -> None:
    made = drive(FORWARDS, VEHICLE, without=("imu",)).readings
    turning = [Imu("imu", r.stamp_ns, 0.0, -0.1, 0.02, 0.0, 0.0, 9.81) for r in made if isinstance(r, Torque)]
    last = balances(VEHICLE, sorted([*made, *turning], key=lambda r: r.stamp_ns))[-1]
    assert last.pitch_radps == pytest.approx(0.1)
    assert last.norm_mps2 == pytest.approx(9.81)


def test_body_s_acceleration_is_the_accelerometer_s_without_the_slope() -> None:
    last = balances(VEHICLE, drive([Leg(2), Leg(4, 0.5), Leg(4, 0.4)], VEHICLE, ground=Ground(0.04, 0.1)).readings)[-1]
    assert last.body_mps2 == pytest.approx(0.4, abs=0.03)
    assert last.accel_mps2 == pytest.approx(0.4, abs=0.03)


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
    silent = [r for r in made.readings if not isinstance(r, Encoder | Torque) or r.stamp_ns <= cut]
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


def test_the_first_accelerometer_is_used_alone() -> None:
    both = replace(VEHICLE, sensors=(*VEHICLE.sensors, SensorConfig("imu-b", "imu")))
    made = drive(FORWARDS, VEHICLE).readings
    bad = [Imu("imu-b", r.stamp_ns, 0.0, 0.0, 0.0, 3.0, 3.0, 3.0) for r in made if isinstance(r, Imu)]
    stream = sorted([*made, *bad], key=lambda r: r.stamp_ns)
    assert balances(both, stream) == balances(VEHICLE, made)


def test_pause_of_the_imu_spoils_no_step() -> None:
    made = drive(FORWARDS, VEHICLE)
    silent = (made.stamps_ns[600], made.stamps_ns[750])
    steps = balances(
        VEHICLE, [r for r in made.readings if not (isinstance(r, Imu) and silent[0] < r.stamp_ns < silent[1])]
    )
    assert max(b.dt_s for b in steps) < 0.07
    assert not [b for b in steps if silent[0] < b.stamp_ns < silent[1]]
    assert steps[-1].unbalanced == pytest.approx(0.04, abs=1e-3)


def test_payload_reading_is_kept_until_the_next() -> None:
    vehicle = loader()
    made = [r for r in drive(FORWARDS, vehicle).readings if not isinstance(r, Payload)]
    stated = [Payload("scale", made[0].stamp_ns, 4000.0)]
    loaded = balances(vehicle, [*stated, *made])
    assert {b.mass_kg for b in loaded} == {21_500.0}
    shares = [b.share for b in loaded]
    empty = [b.share for b in balances(vehicle, made)]
    assert shares == pytest.approx([share * 17.5 / 21.5 for share in empty])


# --- squat ------------------------------------------------------------------------------------------------------------

LOADER = MachineConfig("loader-1", **{**BODY, "wheelbase_m": 3.0, "cog_height_m": 1.0})


@pytest.mark.parametrize(
    ("payload_kg", "force_mps2", "share"),
    [
        (0.0, 0.0, 0.5),  # the load centre lies in the middle
        (4000.0, 0.0, (17_500 * 1.5 + 4000 * 4.7) / (21_500 * 3.0)),
        (0.0, 2.0, 0.5 - 2.0 / math.sqrt(GRAVITY_MPS2**2 - 4) / 3.0),  # uphill, or faster: to the rear
        (0.0, -2.0, 0.5 + 2.0 / math.sqrt(GRAVITY_MPS2**2 - 4) / 3.0),
    ],
)
def test_share_on_the_front_axle(payload_kg: float, force_mps2: float, share: float) -> None:
    assert front_share(LOADER, payload_kg, force_mps2) == pytest.approx(share)
    assert front_share(replace(LOADER, wheelbase_m=0.0), payload_kg, force_mps2) == 0.0


@pytest.mark.parametrize("unknown", ["wheelbase_m", "axle_stiffness_npm"])
def test_without_data_there_is_no_squat_and_none_at_rest_or_beyond_gravity(unknown: str) -> None:
    assert squat_rad(replace(LOADER, **{unknown: 0.0}), 4000, 2.0) == 0.0  # type: ignore[arg-type]
    assert squat_rad(LOADER, 0.0, 0.0) == 0.0
    assert math.isfinite(squat_rad(LOADER, 4000, 30.0))


def test_payload_ahead_of_the_front_axle_lowers_the_nose() -> None:
    """By hand: 4000 kg at 4.7 m put 61.5 kN on the front axle and take 22.2 kN off the rear one."""
    front_n, rear_n = 4000 * GRAVITY_MPS2 * 4.7 / 3.0, 4000 * GRAVITY_MPS2 * (1 - 4.7 / 3.0)
    assert (front_n, rear_n) == pytest.approx((61_455, -22_228), abs=1)
    assert squat_rad(LOADER, 4000, 0.0) == pytest.approx((rear_n - front_n) / (1.8e6 * 3.0))
    assert squat_rad(LOADER, 4000, 0.0) == pytest.approx(-0.015497, abs=1e-6)


def test_acceleration_raises_the_nose() -> None:
    """By hand: 17.5 t at 2 m/s2, 1 m above the ground, shift 11.67 kN from the front axle to the rear one."""
    assert squat_rad(LOADER, 0.0, 2.0) == pytest.approx(2 * 17_500 * 2.0 * 1.0 / 3.0 / (1.8e6 * 3.0), abs=1e-9)
    assert squat_rad(LOADER, 0.0, -2.0) == -squat_rad(LOADER, 0.0, 2.0)


def test_payload_s_height_counts_with_acceleration() -> None:
    more = squat_rad(LOADER, 4000, 2.0) - squat_rad(LOADER, 4000, -2.0)
    assert more == pytest.approx(2 * 2 * 2.0 * (17_500 * 1.0 + 4000 * 0.85) / 3.0 / (1.8e6 * 3.0))


def test_on_a_slope_less_weight_presses_the_tyres() -> None:
    """A machine with its weight at the rear: its squat on level ground is subtracted, what it loses uphill is not."""
    rear_heavy = replace(LOADER, load_centre_m=1.0, cog_height_m=0.0)
    slope_rad = math.radians(20)
    squat = squat_rad(rear_heavy, 0.0, GRAVITY_MPS2 * math.sin(slope_rad))
    weight_n = 17_500 * GRAVITY_MPS2
    assert squat == pytest.approx(weight_n * (2 / 3 - 1 / 3) * (math.cos(slope_rad) - 1) / (1.8e6 * 3.0))
