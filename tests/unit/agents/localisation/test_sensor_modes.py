"""Differential and relative sensors, and configured standard deviations."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from agents.localisation.filters.belief import Belief
from agents.localisation.filters.motion import map_from_base
from agents.localisation.filters.state import YAW
from agents.localisation.localiser import LocalisationConfig
from agents.localisation.sensor_modes import PAIR_S, StampedValue, rate_between
from agents.pipeline import Pipeline
from agents.positioning import PipelineConfig
from protocol.machine.machine_config import MachineConfig, SensorConfig
from protocol.machine.readings import Gps
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
    localiser,
    machine,
    moved,
    thinned,
    with_ahrs,
)

SECOND = 1_000_000_000
EACH_PAIR = pytest.mark.parametrize(  # of choices once
    ("mode", "profile", "engine"),
    [
        ("differential", "default", "ekf"),
        pytest.param("differential", "paper", "ukf", marks=pytest.mark.nightly),  # filterpy's is slow
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


@pytest.mark.parametrize(
    ("seconds", "now", "angles", "rate"),
    [
        (0.5, 2.0, False, 2.0),
        (-0.1, 2.0, False, None),
        (0.0, 2.0, False, None),
        (PAIR_S + 0.01, 2.0, False, None),
        (1.0, 1.0 - 3.5, True, math.tau - 3.5),  # the short way round
    ],
)
def test_a_pair_is_the_rate_at_its_middle_and_as_unsure_as_both(
    seconds: float, now: float, angles: bool, rate: float | None
) -> None:
    first = StampedValue(START_NS, np.array([1.0]), np.array([4.0]))
    second = StampedValue(START_NS + round(seconds * 1e9), np.array([now]), np.array([1.0]))
    mean = rate_between(first, second, angles=angles)
    assert (mean is None) is (rate is None)
    if mean:
        assert mean.stamp_ns == START_NS + round(seconds * 5e8)
        assert (mean.values, mean.variances) == (pytest.approx([rate]), pytest.approx([5.0 / seconds**2]))


# --- GPS -------------------------------------------------------------------------------------------------------------


@EACH_PAIR
@pytest.mark.nightly
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


@pytest.mark.parametrize(("hz", "engine"), [(1, "ekf"), (5, "ukf")])
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
    later = [replace(r, stamp_ns=r.stamp_ns + gap_ns) for r in moved(thinned(second.readings), 300.0, "gps-2")]
    config = PipelineConfig(localisation=LocalisationConfig("ekf", slip=0.0, slip_soft=0.0))
    pipeline = Pipeline(SITE, vehicle, config)
    pipeline.step([*thinned(first.readings), *later])
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
def test_a_relative_heading_leaves_a_wrong_start_to_be_corrected_by_fixes() -> None:
    """The start is 0.1 rad off: the reference is as wrong, and known to be unsure; GPS turns both."""
    vehicle = of_ahrs(mode="relative")
    made = drive([*S_BEND, Leg(40)], vehicle)
    beliefs = localiser(vehicle, start=(10.0, 20.0, 0.76)).beliefs(thinned(with_ahrs(made, 1.0)))
    assert yaw_error(made, beliefs[20]) > 0.04
    assert yaw_error(made, beliefs[-1]) < 0.02


# --- standard deviations ---------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_configured_position_replaces_what_fixes_state() -> None:
    """Stated 1.41 m (2 m2): the same number configured is the same belief, whatever is stated."""
    made = drive(S_BEND[:4], VEHICLE)
    known = changed_sensor(VEHICLE, "gps-1", std={"position": math.sqrt(2.0)})
    boasting = [replace(r, var_e_m2=1e-4, var_n_m2=1e3) if isinstance(r, Gps) else r for r in made.readings]
    expected = localiser(VEHICLE).beliefs(made.readings)[-1]
    located = localiser(known).beliefs(boasting)[-1]
    assert located.x == pytest.approx(expected.x, abs=1e-9)
    assert np.abs(located.P - expected.P).max() < 1e-9
