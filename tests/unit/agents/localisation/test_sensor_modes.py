"""Differential and relative sensors; configured standard deviations."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from agents.localisation.filters.belief import Belief
from agents.localisation.filters.ekf import Ekf
from agents.localisation.filters.motion import HeadingError, MotionModel, motion
from agents.localisation.filters.state import Layout
from agents.localisation.headings import heading_references
from agents.localisation.localiser import LocalisationConfig
from agents.localisation.sensor_modes import PAIR_S, StampedValue, rate_between
from agents.pipeline import Pipeline
from agents.positioning import PipelineConfig
from protocol.machine.machine_config import MachineConfig, SensorConfig
from protocol.machine.readings import Attitude, Gps, Reading
from tests.unit.agents.drives import (
    S_BEND,
    SITE,
    START,
    START_NS,
    VEHICLE,
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


@pytest.mark.parametrize(("hz", "engine"), [(1, "ekf"), (5, "ukf")])
def test_velocity_of_an_antenna_far_off_the_axle_is_free_of_bias_in_a_bend(hz: int, engine: str) -> None:
    """At 1 Hz, 0.3 rad/s a pair's mean differs from the velocity at its end: heading and speed must not lag."""
    vehicle = of_gps("differential")
    vehicle = changed_sensor(vehicle, "gps-1", std={"position": 0.01}, drift_share=0.0)
    made = drive([Leg(4, 0.5), Leg(20, 0.0, 0.3)], vehicle)
    fixes = [r for r in made.readings if isinstance(r, Gps)][:: 5 // hz]
    readings = sorted([*(r for r in made.readings if not isinstance(r, Gps)), *fixes], key=lambda r: r.stamp_ns)
    located = localiser(vehicle, start=START, filter=engine)
    last = located.beliefs(readings)[-1]
    assert made.turned_rad(last) < 0.01
    assert last.x[6] == pytest.approx(2.0, abs=0.03)
    assert located.counters["gps-1_used"] >= len(fixes) - 2


def test_a_first_fix_that_is_too_late_is_no_reference() -> None:
    vehicle = of_gps("relative")
    made = drive(S_BEND, vehicle)
    fixes = [r for r in made.readings if isinstance(r, Gps)]
    others = [r for r in made.readings if not isinstance(r, Gps)]
    cut = next(i for i, r in enumerate(others) if after(r, 20))
    old = moved(fixes[40:41], 900.0)  # of second 8, elsewhere
    readings = [*others[:cut], *old, *sorted([*others[cut:], *fixes[100:]], key=lambda r: r.stamp_ns)]
    located = localiser(vehicle, start=START)
    assert max(map(made.off_m, located.beliefs(readings))) < 0.6
    assert (located.counters["too_late"], located.counters["gps-1_gated"]) == (1, 0)


def test_a_relative_receiver_does_not_make_a_wrong_start_sure() -> None:
    """Its first fix takes the place from the belief: no information."""
    vehicle = of_gps("relative")
    made = drive([Leg(5), Leg(4, 0.5), Leg(20)], vehicle)
    stds = [math.sqrt(np.trace(b.P[:2, :2])) for b in localiser(vehicle, start=START).beliefs(thinned(made.readings))]
    assert stds[-1] > 0.7 * stds[0]


@pytest.mark.slow
def test_a_restart_takes_a_new_reference() -> None:
    vehicle = of_gps("relative", receivers=2)  # the absolute one gives the place after a restart
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


def of_ahrs(**options: Any) -> MachineConfig:
    return replace(VEHICLE, sensors=(*VEHICLE.sensors, SensorConfig("ahrs", "attitude", **options)))


@pytest.mark.slow
def test_a_relative_heading_leaves_a_wrong_start_to_be_corrected_by_fixes() -> None:
    """Start error 0.1 rad: the reference inherits it as uncertainty, and GPS corrects both."""
    vehicle = of_ahrs(mode="relative")
    made = drive([*S_BEND, Leg(40)], vehicle)
    beliefs = localiser(vehicle, start=(10.0, 20.0, 0.76)).beliefs(thinned(with_ahrs(made, 1.0)))
    assert made.turned_rad(beliefs[20]) > 0.04
    assert made.turned_rad(beliefs[-1]) < 0.02


@pytest.mark.slow
def test_a_configured_position_replaces_what_fixes_state() -> None:
    """Stated 1.41 m (2 m2): the same number configured gives the same belief, whatever is stated."""
    readings = thinned(drive(S_BEND[:4], VEHICLE).readings)
    known = changed_sensor(VEHICLE, "gps-1", std={"position": math.sqrt(2.0)})
    boasting = [replace(r, var_e_m2=1e-4, var_n_m2=1e3) if isinstance(r, Gps) else r for r in readings]
    expected = localiser(VEHICLE).beliefs(readings)[-1]
    located = localiser(known).beliefs(boasting)[-1]
    assert located.x == pytest.approx(expected.x, abs=1e-9)
    assert np.abs(located.P - expected.P).max() < 1e-9


# --- absolute headings: slow error states, also without GPS ----------------------------------------------------------

STATED = math.radians(1.5) ** 2
LAPS = (Leg(4, 1.0), *([Leg(8), Leg(6, 0.0, 0.25), Leg(5), Leg(6, 0.0, -0.25)] * 4))  # 104 s


def until(readings: list[Reading], fixes_s: float) -> list[Reading]:
    """Fixes up to then, none after."""
    return [r for r in thinned(readings) if not (isinstance(r, Gps) and after(r, fixes_s))]


def turned(readings: list[Reading], by_rad: float, from_s: float) -> list[Reading]:
    """The reference with a heading error from then on."""
    c, s = math.cos(by_rad / 2), math.sin(by_rad / 2)
    return [
        replace(r, qz=r.qz * c + r.qw * s, qw=r.qw * c - r.qz * s)
        if isinstance(r, Attitude) and after(r, from_s)
        else r
        for r in readings
    ]


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize("wrong_deg", [8.0, -25.0])
def test_an_error_larger_than_stated_is_learnt_and_does_no_harm(wrong_deg: float) -> None:
    """While fixes show the heading, and later without them."""
    vehicle = of_ahrs()
    made = drive(LAPS, vehicle)
    readings = until(with_ahrs(made, math.radians(wrong_deg), variance=STATED), 60.0)
    with_it, without = localiser(vehicle), localiser(VEHICLE)
    with_it.run(readings)
    without.run([r for r in readings if r.sensor != "ahrs"])
    assert made.turned_rad(with_it.belief) < max(made.turned_rad(without.belief), math.radians(2))
    assert made.off_m(with_it.belief) < made.off_m(without.belief) + 3.0


@pytest.mark.slow
@pytest.mark.parametrize("fixes_s", [pytest.param(1000.0, marks=pytest.mark.nightly), 60.0])
def test_a_reference_that_jumps_is_refused_then_learnt_anew(fixes_s: float) -> None:
    """Steel beside the sensor: 60 degrees at once, with and without GPS."""
    vehicle = of_ahrs()
    made = drive(LAPS, vehicle)
    located = localiser(vehicle)
    located.run(turned(until(with_ahrs(made, variance=STATED), fixes_s), math.radians(60), 90.0))
    assert located.counters["ahrs_gated"] >= 15
    assert located.counters["ahrs_relocked"] == 1
    assert made.turned_rad(located.belief) < 0.05


def test_without_readings_its_error_becomes_what_it_was_at_first() -> None:
    """Stationary: a known error fades and its variance returns, in steps of any length."""
    layout = Layout(imus=1, references=1)
    error = layout.heading_errors.start
    model = MotionModel(layout, heading_errors=(HeadingError(0.05, 100.0),))
    x, P = np.zeros(layout.n), np.eye(layout.n) * 1e-6
    x[error] = 0.1
    one = Belief(0, x, P)
    once = Ekf().predict(one, motion(model, one, 60.0), 60_000_000_000)
    for i in range(60):
        one = Ekf().predict(one, motion(model, one, 1.0), (i + 1) * 1_000_000_000)
    for belief in (once, one):
        assert belief.x[error] == pytest.approx(0.1 * math.exp(-0.6))
        assert belief.P[error, error] == pytest.approx(0.05**2 + (1e-6 - 0.05**2) * math.exp(-1.2))


def test_headings_of_the_front_frame_and_of_pairs_have_no_state() -> None:
    sensors = [
        SensorConfig("relative", "attitude", mode="relative"),
        SensorConfig("front", "attitude", frame="front_link"),
        SensorConfig("pairs", "attitude", mode="differential"),
        SensorConfig("tilt", "attitude", measures=("tilt",)),
        SensorConfig("absolute", "attitude"),
    ]
    assert [s.name for s in heading_references(sensors)] == ["absolute", "relative"]
