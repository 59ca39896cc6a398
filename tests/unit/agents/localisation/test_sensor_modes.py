"""Differential and relative sensors, and configured standard deviations."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from agents.localisation.filters.belief import Belief, anchor_states, reset_states
from agents.localisation.filters.motion import HEADING_WALK, map_from_base, motion
from agents.localisation.filters.state import YAW, Layout
from agents.localisation.localiser import LocalisationConfig
from agents.localisation.sensor_modes import PAIR_S, StampedValue, rate_between
from agents.pipeline import Pipeline
from agents.positioning import PipelineConfig
from protocol.arrays import Floats
from protocol.machine.machine_config import MachineConfig, SensorConfig
from protocol.machine.readings import Attitude, Encoder, Gps, Reading
from tests.unit.agents.drives import (
    PROJECTION,
    S_BEND,
    SITE,
    START,
    START_NS,
    VEHICLE,
    Drive,
    Leg,
    after,
    changed_sensor,
    drive,
    fix,
    localiser,
    machine,
    with_ahrs,
)

SECOND = 1_000_000_000
MODES = pytest.mark.parametrize("mode", ["differential", "relative"])
PROFILES = pytest.mark.parametrize("profile", ["default", "paper"])
BOTH = pytest.mark.parametrize("engine", ["ekf", "ukf"])
EACH_PAIR = pytest.mark.parametrize(  # of choices once
    ("mode", "profile", "engine"),
    [
        ("differential", "default", "ekf"),
        ("differential", "paper", "ukf"),
        ("relative", "default", "ukf"),
        ("relative", "paper", "ekf"),
    ],
)


def errors(made: Drive, beliefs: list[Belief], east_m: float = 0.0, north_m: float = 0.0) -> list[float]:
    """Distances [m] from the truth, or from what lies so far off it."""
    distances = []
    for b in beliefs:
        x, y, _ = made.at(b.stamp_ns)
        distances.append(math.dist(b.x[:2], (x + east_m, y + north_m)))
    return distances


def of_gps(mode: str, receivers: int = 1) -> MachineConfig:
    return changed_sensor(machine(receivers=receivers), f"gps-{receivers}", mode=mode)


def moved(readings: list[Reading], north_m: float, sensor: str = "gps-1") -> list[Reading]:
    return [
        replace(r, lat_deg=r.lat_deg + north_m / 111_200) if isinstance(r, Gps) and r.sensor == sensor else r
        for r in readings
    ]


# --- pairs and references --------------------------------------------------------------------------------------------


def value(seconds: float, values: list[float], variance: float = 1.0) -> StampedValue:
    return StampedValue(START_NS + round(seconds * 1e9), np.array(values), np.full(len(values), variance))


def test_a_pair_is_the_rate_at_its_middle_and_as_unsure_as_both() -> None:
    mean = rate_between(value(1.0, [1.0, 2.0], 4.0), value(1.5, [2.0, 1.0], 1.0))
    assert mean.stamp_ns == START_NS + 1_250_000_000
    assert mean.values == pytest.approx([2.0, -2.0])
    assert mean.variances == pytest.approx([20.0, 20.0])


@pytest.mark.parametrize("seconds", [-0.1, 0.0, PAIR_S + 0.01, 10.0])
def test_readings_far_apart_or_in_disorder_are_no_pair(seconds: float) -> None:
    assert rate_between(value(1.0, [0.0]), value(1.0 + seconds, [1.0])) is None


def test_a_pair_of_angles_goes_the_short_way_round() -> None:
    mean = rate_between(value(0.0, [3.1]), value(1.0, [-3.1]), angles=True)
    assert mean.values == pytest.approx([2 * math.pi - 6.2])


def test_a_value_that_counts_from_an_anchor_does_not_show_where_the_anchor_was() -> None:
    """Reading = state + error, with the error minus what the state was off: known, however unsure the state is."""
    P = np.random.default_rng(5).normal(size=(5, 5))
    belief = Belief(START_NS, np.arange(5.0), P @ P.T + np.eye(5))
    states, H = slice(3, 5), np.array([[1.0, 0.0, 0.5, 0.0, 0.0], [0.0, 2.0, 0.0, 0.0, 0.0]])
    anchored = anchor_states(belief, states, H, 0.3)
    seen = H.copy()
    seen[:, states] = np.eye(2)
    assert seen @ anchored.P @ seen.T == pytest.approx(0.3 * np.eye(2))
    assert anchored.P[:3, :3] == pytest.approx(belief.P[:3, :3])
    assert anchored.x.tolist() == [0.0, 1.0, 2.0, 0.0, 0.0]
    assert np.linalg.eigvalsh(anchored.P).min() > 0
    assert reset_states(belief, states, 0.3).P[:, states] == pytest.approx(0.3 * np.eye(5)[:, states])


# --- GPS -------------------------------------------------------------------------------------------------------------


@EACH_PAIR
def test_a_machine_with_such_a_receiver_alone_never_aligns_but_runs_from_a_start(
    mode: str, profile: str, engine: str
) -> None:
    """Its fixes are a kilometre off, and it drives on from the given start."""
    vehicle = of_gps(mode)
    made = drive(S_BEND, vehicle)
    readings = moved(made.readings, 1000.0)
    assert not localiser(vehicle, profile=profile).is_aligned
    lost = localiser(vehicle, profile=profile, filter=engine)
    assert lost.beliefs(readings) == []
    located = localiser(vehicle, profile=profile, filter=engine, start=START)
    assert max(errors(made, located.beliefs(readings))) < 0.6
    assert located.counters["gps-1_used"] > 100
    assert located.counters["gps-1_gated"] == 0


@pytest.mark.slow
@MODES
def test_the_start_heading_comes_from_absolute_receivers_alone(mode: str) -> None:
    vehicle = of_gps(mode, receivers=2)
    made = drive(S_BEND, vehicle)
    straight, off = localiser(vehicle), localiser(vehicle)
    expected = straight.beliefs(made.readings)[0]
    assert off.beliefs(moved(made.readings, 300.0, "gps-2"))[0].x[:2] == pytest.approx(expected.x[:2], abs=0.3)
    assert off.counters["gps-2_used"] > 100


@pytest.mark.slow
def test_differential_receiver_shows_speed_and_heading_where_wheels_are_wrong() -> None:
    """Wheels that turn a fifth too much, and no state for it in the paper's profile: fixes 200 m off hold the speed."""
    drifts = {}
    for mode in ("differential", None):
        vehicle = of_gps(mode or "absolute")
        vehicle = changed_sensor(vehicle, "wheels", std={"speed": 1.0})
        vehicle = changed_sensor(vehicle, "gps-1", std={"position": 0.05}) if mode else vehicle
        made = drive([*S_BEND, Leg(20)], vehicle)
        readings = [
            replace(r, left_ticks=1.2 * r.left_ticks, right_ticks=1.2 * r.right_ticks) if isinstance(r, Encoder) else r
            for r in moved(made.readings, 200.0)
            if mode or not isinstance(r, Gps)
        ]
        drifts[mode] = errors(made, localiser(vehicle, start=START, profile="paper").beliefs(readings))[-1]
    assert drifts["differential"] < 0.5 * drifts[None], drifts


@BOTH
@pytest.mark.parametrize("hz", [1, 5])
def test_velocity_of_an_antenna_far_off_the_axle_is_free_of_bias_in_a_bend(hz: int, engine: str) -> None:
    """At 1 Hz and 0.3 rad/s the mean over a pair is not the velocity at its end: heading and speed must not lag."""
    vehicle = of_gps("differential")
    vehicle = changed_sensor(vehicle, "gps-1", std={"position": 0.01}, drift_share=0.0)
    made = drive([Leg(4, 0.5), Leg(20, 0.0, 0.3)], vehicle)
    fixes = [r for r in made.readings if isinstance(r, Gps)][:: 5 // hz]
    readings = sorted([*(r for r in made.readings if not isinstance(r, Gps)), *fixes], key=lambda r: r.stamp_ns)
    located = localiser(vehicle, start=START, filter=engine)
    last = located.beliefs(readings)[-1]
    assert abs(math.remainder(last.x[YAW] - made.at(last.stamp_ns)[2], math.tau)) < 0.01
    assert last.x[6] == pytest.approx(2.0, abs=0.03)
    assert located.counters["gps-1_used"] >= len(fixes) - 2


def test_differential_receiver_has_no_slow_error_and_a_relative_one_has() -> None:
    for mode, receivers in (("differential", 0), ("relative", 1), ("absolute", 1)):
        vehicle = of_gps(mode)
        beliefs = localiser(vehicle, start=START).beliefs(drive([Leg(2, 0.5)], vehicle).readings)
        assert len(beliefs[-1].x) == Layout(1, True, receivers).n


@pytest.mark.parametrize(("time_s", "slow"), [(1e-3, 1.0), (1e9, 0.0)])
def test_slow_errors_cancel_in_a_velocity_but_for_what_they_change_meanwhile(time_s: float, slow: float) -> None:
    """Two fixes 0.5 s apart, of 4 m2 each: a quarter of it is white."""
    vehicle = changed_sensor(of_gps("differential"), "gps-1", drift_time_s=time_s)
    located = localiser(vehicle, start=START)
    gps = fix(SensorConfig("gps-1", "gps"), START_NS, 3.0, 4.0, 0.0, 4.0)
    pair = (gps, replace(gps, stamp_ns=START_NS + SECOND // 2))
    first, second = (
        located._tracker.receivers.measurement(located._tracker.receivers.fix(r, located.dead_reckoning.pose))
        for r in pair
    )
    assert first is None
    assert np.diag(second.R).tolist() == pytest.approx([2 * (1.0 + 3.0 * slow) / 0.5**2] * 2)


def test_error_of_a_relative_receiver_is_that_of_two_fixes_and_of_the_belief_then() -> None:
    vehicle = of_gps("relative")
    located = localiser(vehicle, start=START)
    made = drive([Leg(2)], vehicle)
    believed = next(b for b in located.beliefs(made.readings) if b.stamp_ns > START_NS + SECOND // 5)
    expected = 2 * 0.75 * 2.0 + float(np.trace(believed.P[:2, :2])) / 2
    assert located._tracker.receivers.errors[0].variance_m2 == pytest.approx(expected, rel=0.15)


def test_fixes_far_apart_make_no_velocity() -> None:
    vehicle = of_gps("differential")
    made = drive(S_BEND, vehicle)
    fixes = [r for r in made.readings if isinstance(r, Gps)][::6]  # every 1.2 s
    located = localiser(vehicle, start=START)
    located.beliefs(sorted([*(r for r in made.readings if not isinstance(r, Gps)), *fixes], key=lambda r: r.stamp_ns))
    assert located.counters["gps-1_used"] == 0


def test_relative_receivers_are_shifted_each_by_its_own_first_fix() -> None:
    vehicle = machine(receivers=3)
    vehicle = changed_sensor(changed_sensor(vehicle, "gps-2", mode="relative"), "gps-3", mode="relative")
    made = drive(S_BEND, vehicle)
    readings = moved(moved(made.readings, 70.0, "gps-2"), -4000.0, "gps-3")
    located = localiser(vehicle)
    assert max(errors(made, located.beliefs(readings))) < 0.5
    assert min(located.counters["gps-2_used"], located.counters["gps-3_used"]) > 100
    assert located.counters["gps-2_gated"] == located.counters["gps-3_gated"] == 0


@pytest.mark.slow
def test_a_relative_receiver_that_comes_late_counts_from_the_belief_at_its_first_stamp() -> None:
    """The machine drives 0.8 m while its fixes are on their way."""
    vehicle = of_gps("relative")
    made = drive([*S_BEND, Leg(20)], vehicle)
    readings = moved([r for r in made.readings if not isinstance(r, Gps) or after(r, 15)], 500.0)
    late = sorted(readings, key=lambda r: r.stamp_ns + (400_000_000 if isinstance(r, Gps) else 0))
    located = localiser(vehicle, start=START, profile="paper")
    assert max(errors(made, located.beliefs(late))) < 0.6
    assert located.counters["gps-1_used"] > 100


def test_a_first_fix_that_is_too_late_is_no_reference() -> None:
    vehicle = of_gps("relative")
    made = drive(S_BEND, vehicle)
    fixes = [r for r in made.readings if isinstance(r, Gps)]
    others = [r for r in made.readings if not isinstance(r, Gps)]
    cut = next(i for i, r in enumerate(others) if after(r, 20))
    old = moved(fixes[40:41], 900.0)  # of second 8, and elsewhere
    readings = [*others[:cut], *old, *sorted([*others[cut:], *fixes[100:]], key=lambda r: r.stamp_ns)]
    located = localiser(vehicle, start=START)
    assert max(errors(made, located.beliefs(readings))) < 0.6
    assert (located.counters["too_late"], located.counters["gps-1_gated"]) == (1, 0)


def test_a_relative_receiver_does_not_make_a_wrong_start_sure() -> None:
    """What its first fix says of the place it takes from the belief: that is no news."""
    vehicle = of_gps("relative")
    made = drive([Leg(5), Leg(4, 0.5), Leg(20)], vehicle)
    stds = [math.sqrt(np.trace(b.P[:2, :2])) for b in localiser(vehicle, start=START).beliefs(made.readings)]
    assert stds[-1] > 0.7 * stds[0]


@pytest.mark.slow
def test_a_restart_takes_a_new_reference() -> None:
    vehicle = of_gps("relative", receivers=2)  # the absolute one shows where it is after the restart
    first, second = drive(S_BEND, vehicle), drive(S_BEND, vehicle)
    gap_ns = 1000 * SECOND
    later = [replace(r, stamp_ns=r.stamp_ns + gap_ns) for r in moved(second.readings, 300.0, "gps-2")]
    config = PipelineConfig(localisation=LocalisationConfig(slip=0.0, slip_soft=0.0))
    pipeline = Pipeline(SITE, vehicle, config)
    pipeline.step([*first.readings, *later])
    pose = pipeline.pose
    assert pose.stamp_ns > START_NS + gap_ns
    assert math.dist((pose.x_m, pose.y_m), second.at(pose.stamp_ns - gap_ns)[:2]) < 0.6
    assert pipeline.health()["counters"].get("gps-2_gated", 0) == 0


def test_relative_fixes_are_those_of_the_paper_s_transform_seen_from_the_shared_map() -> None:
    """The paper maps fixes into the vehicle's world by a rigid transform, of a receiver's first fix and the start's
    roll, pitch and yaw. With the same start, world to map is its inverse at the believed antenna. The site's plane
    stands for UTM: both are transverse Mercator.
    """
    rng, sensor = np.random.default_rng(11), SensorConfig("gps-1", "gps", mode="relative")
    vehicle = replace(machine(receivers=0), sensors=(*machine(receivers=0).sensors, sensor))
    located = localiser(vehicle, start=START)
    located.beliefs(drive([Leg(1)], vehicle, without=("gps-1",)).readings)
    fusion = located._tracker.fusion
    roll_pitch_yaw = rng.normal(size=3) * (0.1, 0.1, 2.0)
    turn = map_from_base(roll_pitch_yaw)
    places = np.array([100.0, -50.0, 7.0]) + rng.normal(size=(5, 3)) * 30
    world_from_utm, map_from_world = np.eye(4), np.eye(4)
    world_from_utm[:3, :3], world_from_utm[:3, 3] = turn.T, -turn.T @ places[0]
    stamp = located.belief.stamp_ns
    believed = fusion.at(stamp).x[:3]  # no lever arm: the antenna is the machine
    map_from_world[:3, :3], map_from_world[:3, 3] = turn, believed
    for i, place in enumerate(places):
        geodetic = PROJECTION.to_geodetic(*place.tolist())
        raw = located._tracker.receivers.fix(Gps("gps-1", stamp, *geodetic, 1.0, 1.0, 1.0), located.dead_reckoning.pose)
        if i == 0:
            located._tracker.receivers.anchor(raw, fusion.at(stamp))
        shifted = located._tracker.receivers.measurement(raw)
        paper = map_from_world @ world_from_utm @ np.append(place, 1.0)
        assert shifted.z == pytest.approx(paper[:2], abs=1e-5)


# --- attitude --------------------------------------------------------------------------------------------------------


def of_ahrs(**options: Any) -> MachineConfig:
    return replace(VEHICLE, sensors=(*VEHICLE.sensors, SensorConfig("ahrs", "attitude", **options)))


def yaw_error(made: Drive, belief: Belief) -> float:
    return abs(math.remainder(belief.x[YAW] - made.at(belief.stamp_ns)[2], math.tau))


@pytest.mark.slow
@EACH_PAIR
def test_an_attitude_that_is_far_off_is_used_in_its_mode_in_both_profiles(mode: str, profile: str, engine: str) -> None:
    vehicle = of_ahrs(mode=mode)
    made = drive(S_BEND, vehicle)
    located = localiser(vehicle, profile=profile, filter=engine, start=START)
    beliefs = located.beliefs(with_ahrs(made, 2.0))
    assert located.counters["ahrs_used"] > 500
    assert located.counters["ahrs_gated"] == 0
    assert max(yaw_error(made, b) for b in beliefs) < 0.06
    assert max(errors(made, beliefs)) < 0.6


@pytest.mark.slow
@MODES
def test_an_attitude_in_its_mode_holds_the_heading_where_the_gyro_is_wrong(mode: str) -> None:
    """A gyro that is off by 0.02 rad/s, with no fixes: over 25 s that is half a radian."""
    wrong = {}
    for seen in ("ahrs", ""):
        vehicle = changed_sensor(of_ahrs(mode=mode, std={"heading": 1e-3}), "imu", std={"rate": 0.05})
        made = drive(S_BEND, vehicle)
        readings = [
            replace(r, gyro_z_radps=r.gyro_z_radps + 0.02) if r.kind == "imu" else r  # type: ignore[call-arg]
            for r in with_ahrs(made, 1.0)
            if not isinstance(r, Gps) and (seen or not isinstance(r, Attitude))
        ]
        wrong[seen] = yaw_error(made, localiser(vehicle, start=START).beliefs(readings)[-1])
    assert wrong["ahrs"] < 0.3 * wrong[""], wrong


@pytest.mark.slow
@PROFILES
def test_a_relative_heading_that_comes_late_counts_from_the_belief_then(profile: str) -> None:
    vehicle = of_ahrs(mode="relative", measures=("heading",))
    made = drive(S_BEND, vehicle)
    readings = sorted(
        with_ahrs(made, 1.5, from_s=18.5), key=lambda r: r.stamp_ns + (400_000_000 if r.sensor == "ahrs" else 0)
    )  # it turns by 0.1 rad while a reading is on its way
    located = localiser(vehicle, profile=profile, start=START)
    beliefs = located.beliefs(readings)
    assert located.counters["ahrs_used"] > 100
    assert max(yaw_error(made, b) for b in beliefs) < 0.05


def test_tilt_of_a_relative_attitude_stays_absolute() -> None:
    vehicle = of_ahrs(mode="relative")
    made = drive([Leg(10)], vehicle)
    half = 0.1 / 2
    tilted = [
        replace(r, qx=math.sin(half), qz=0.0, qw=math.cos(half)) if isinstance(r, Attitude) else r
        for r in with_ahrs(made)
    ]
    assert localiser(vehicle, start=START).beliefs(tilted)[-1].x[3] == pytest.approx(0.1, abs=0.02)


@pytest.mark.slow
def test_a_relative_heading_leaves_a_wrong_start_to_be_corrected_by_fixes() -> None:
    """The start is 0.1 rad off: the reference is as wrong, and known to be unsure; GPS turns both."""
    vehicle = of_ahrs(mode="relative")
    made = drive([*S_BEND, Leg(40)], vehicle)
    beliefs = localiser(vehicle, start=(10.0, 20.0, 0.76)).beliefs(with_ahrs(made, 1.0))
    assert yaw_error(made, beliefs[20]) > 0.04
    assert yaw_error(made, beliefs[-1]) < 0.02


def test_heading_of_a_reference_wanders_as_the_machine_s_own() -> None:
    vehicle = of_ahrs(mode="relative", measures=("heading",))
    located = localiser(vehicle, start=START)
    located.beliefs(drive([Leg(1)], vehicle).readings)
    model = located._tracker.fusion.model
    error = model.layout.heading_errors.start
    assert error == len(located.belief.x) - 1
    assert motion(model, located.belief, 2.0).Q[error, error] == pytest.approx(2.0 * HEADING_WALK**2)


# --- standard deviations ---------------------------------------------------------------------------------------------

STD = [
    ("gps-1", "position", 5.0),
    ("imu", "rate", 0.1),
    ("imu", "force", 0.2),
    ("wheels", "speed", 0.5),
    ("ahrs", "tilt", 0.2),
    ("ahrs", "heading", 0.2),
]


def final(vehicle: MachineConfig, made: Drive) -> Floats:
    belief = localiser(vehicle, start=START).beliefs(with_ahrs(made))[-1]
    return np.concatenate([belief.x, belief.P.ravel()])


@pytest.mark.parametrize(("sensor", "name", "std"), STD)
def test_each_standard_deviation_counts(sensor: str, name: str, std: float) -> None:
    vehicle = of_ahrs(mode="relative")
    made = drive([Leg(4, 0.5), Leg(6, 0.0, 0.2)], vehicle)
    changed = final(changed_sensor(vehicle, sensor, std={name: std}), made)
    assert np.abs(changed - final(vehicle, made)).max() > 1e-6


@pytest.mark.slow
def test_a_configured_position_replaces_what_fixes_state() -> None:
    """Stated 1.41 m (2 m2): the same number configured is the same belief, whatever is stated."""
    made = drive(S_BEND, VEHICLE)
    known = changed_sensor(VEHICLE, "gps-1", std={"position": math.sqrt(2.0)})
    boasting = [replace(r, var_e_m2=1e-4, var_n_m2=1e3) if isinstance(r, Gps) else r for r in made.readings]
    expected = localiser(VEHICLE).beliefs(made.readings)[-1]
    located = localiser(known).beliefs(boasting)[-1]
    assert located.x == pytest.approx(expected.x, abs=1e-9)
    assert np.abs(located.P - expected.P).max() < 1e-9


@pytest.mark.slow
def test_a_configured_position_may_be_better_than_receivers_are_believed_to_be() -> None:
    vehicle, stds = machine(), []
    for std in (0.02, 0.3):  # min_fix_std_m is 0.3
        known = changed_sensor(vehicle, "gps-1", std={"position": std}, drift_share=0.0)
        stds.append(math.sqrt(np.trace(localiser(known).beliefs(drive(S_BEND, vehicle).readings)[-1].P[:2, :2])))
    assert stds[0] < 0.6 * stds[1]


@pytest.mark.slow
def test_a_configured_heading_replaces_what_an_attitude_states() -> None:
    vehicle = of_ahrs(mode="relative", std={"heading": 0.01, "tilt": 0.01})
    plain = of_ahrs(mode="relative")
    made = drive(S_BEND, vehicle)
    boasting = localiser(vehicle, start=START).beliefs(with_ahrs(made, variance=1.0))[-1]
    assert boasting.x == pytest.approx(localiser(plain, start=START).beliefs(with_ahrs(made))[-1].x, abs=1e-9)


def test_a_made_up_fix_lies_where_it_should() -> None:
    """The helper of these tests, against the projection that the localiser uses."""
    made = fix(SensorConfig("gps-1", "gps"), START_NS, 3.0, 4.0, 0.0)
    assert PROJECTION.to_map(made.lat_deg, made.lon_deg, made.height_m)[:2] == pytest.approx((3.0, 4.0), abs=1e-6)
