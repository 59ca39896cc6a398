"""Absolute headings of attitude references: slow errors that have states, and what they do without GPS."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from agents.localisation.filters.belief import Belief
from agents.localisation.filters.ekf import Ekf
from agents.localisation.filters.motion import HeadingError, MotionModel, motion
from agents.localisation.filters.state import YAW, Layout
from agents.localisation.headings import heading_references
from protocol.machine.machine_config import MachineConfig, SensorConfig
from protocol.machine.readings import Attitude, Gps, Reading
from tests.unit.agents.drives import VEHICLE as WITHOUT
from tests.unit.agents.drives import (
    Drive,
    Leg,
    RunLocaliser,
    after,
    drive,
    localiser,
    thinned,
    with_ahrs,
)

STATED = math.radians(1.5) ** 2
LAPS = (Leg(4, 1.0), *([Leg(8), Leg(6, 0.0, 0.25), Leg(5), Leg(6, 0.0, -0.25)] * 6))


def of_ahrs(**options: Any) -> MachineConfig:
    return replace(WITHOUT, sensors=(*WITHOUT.sensors, SensorConfig("ahrs", "attitude", **options)))


def until(readings: list[Reading], fixes_s: float) -> list[Reading]:
    """Fixes up to there, nothing of them afterwards."""
    return [r for r in thinned(readings) if not (isinstance(r, Gps) and after(r, fixes_s))]


def turned(readings: list[Reading], by_rad: float, from_s: float) -> list[Reading]:
    """The reference off by an angle from a time on."""
    c, s = math.cos(by_rad / 2), math.sin(by_rad / 2)
    return [
        replace(r, qz=r.qz * c + r.qw * s, qw=r.qw * c - r.qz * s)
        if isinstance(r, Attitude) and after(r, from_s)
        else r
        for r in readings
    ]


def off_rad(located: RunLocaliser, made: Drive) -> float:
    belief = located.belief
    return abs(math.remainder(float(belief.x[YAW]) - made.at(belief.stamp_ns)[2], math.tau))


def off_m(located: RunLocaliser, made: Drive) -> float:
    belief = located.belief
    x, y, _ = made.at(belief.stamp_ns)
    return math.dist(belief.x[:2], (x, y))


@pytest.mark.slow
@pytest.mark.parametrize("wrong_deg", [pytest.param(8.0, marks=pytest.mark.nightly), -25.0])
def test_an_error_larger_than_stated_is_learnt_and_does_no_harm(wrong_deg: float) -> None:
    """While fixes show the heading, and in the two minutes without them that follow."""
    vehicle = of_ahrs()
    made = drive(LAPS, vehicle)
    readings = until(with_ahrs(made, math.radians(wrong_deg), variance=STATED), 60.0)
    with_it, without = localiser(vehicle), localiser(WITHOUT)
    with_it.run(readings)
    without.run([r for r in readings if r.sensor != "ahrs"])
    assert off_rad(with_it, made) < max(off_rad(without, made), math.radians(2))
    assert off_m(with_it, made) < off_m(without, made) + 3.0  # of 300 m; not learnt, 8 degrees would cost 40 m


@pytest.mark.slow
@pytest.mark.parametrize("fixes_s", [pytest.param(1000.0, marks=pytest.mark.nightly), 60.0])
def test_a_reference_that_jumps_is_refused_then_learnt_anew(fixes_s: float) -> None:
    """A load of steel beside the sensor: 60 degrees at once, with GPS and without."""
    vehicle = of_ahrs()
    made = drive(LAPS, vehicle)
    located = localiser(vehicle)
    located.run(turned(until(with_ahrs(made, variance=STATED), fixes_s), math.radians(60), 90.0))
    assert located.counters["ahrs_gated"] >= 15
    assert located.counters["ahrs_relocked"] == 1
    assert off_rad(located, made) < 0.05


def test_without_readings_its_error_becomes_what_it_was_at_first() -> None:
    """Stationary: an error that is known fades, and its variance comes back, in steps of any length."""
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
