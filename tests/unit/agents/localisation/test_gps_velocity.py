"""Velocity by Doppler: its model, and what it changes in the filter."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from agents.localisation.filters.state import ATTITUDE, RATE, SPEED, VELOCITY, YAW, Layout
from agents.localisation.gps_velocity import MIN_STD_MPS, gps_velocity
from protocol.arrays import Floats
from protocol.machine.machine_config import MachineConfig, Mount, SensorConfig
from protocol.machine.readings import Encoder, Gps, GpsVelocity, Reading
from tests.unit.agents.drives import (
    LEVER_M,
    S_BEND,
    START,
    START_NS,
    TRUE_STEP_S,
    VEHICLE,
    Drive,
    Leg,
    after,
    drive,
    localiser,
)

DOPPLER = SensorConfig("doppler", "gps_velocity", Mount(LEVER_M))
WITH_DOPPLER = replace(VEHICLE, sensors=(*VEHICLE.sensors, DOPPLER))
LAYOUT = Layout(imus=1, wheel_scale=True, receivers=1)
LONG = (*S_BEND, Leg(10), Leg(6, 0, 0.25), Leg(20))


def doppler(made: Drive, seed: int = 0, std_mps: float = 0.0, every: int = 20) -> list[GpsVelocity]:
    """Velocity of the antenna 5 times a second, of a machine on the plane."""
    rng = np.random.default_rng(seed)
    turn = np.gradient(made.heading_rad, TRUE_STEP_S)
    ahead, left = made.speed_mps - turn * LEVER_M[1], turn * LEVER_M[0]
    c, s = np.cos(made.heading_rad), np.sin(made.heading_rad)
    moving = np.stack([c * ahead - s * left, s * ahead + c * left], axis=1)
    moving += std_mps * rng.standard_normal(moving.shape)
    variance = max(std_mps, 0.1) ** 2
    rows = zip(made.stamps_ns[::every], moving[::every].tolist(), strict=True)
    return [GpsVelocity("doppler", stamp, east, north, variance, variance) for stamp, (east, north) in rows]


def merged(*readings: Sequence[Reading]) -> list[Reading]:
    return sorted((r for some in readings for r in some), key=lambda r: r.stamp_ns)


def silenced(readings: Sequence[Reading], from_s: float) -> list[Reading]:
    """Without fixes from some time on."""
    return [r for r in readings if not (isinstance(r, Gps) and after(r, from_s))]


def larger_wheels(readings: Sequence[Reading], scale: float) -> list[Reading]:
    """Wheels that count too many ticks."""
    return [
        replace(r, left_ticks=r.left_ticks * scale, right_ticks=r.right_ticks * scale) if isinstance(r, Encoder) else r
        for r in readings
    ]


def end_error_m(vehicle: MachineConfig, made: Drive, readings: Sequence[Reading]) -> float:
    poses = localiser(vehicle, filter="ekf").run(readings)
    return math.dist((poses[-1].x_m, poses[-1].y_m), made.at(poses[-1].stamp_ns)[:2])


# --- the model -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(5))
def test_jacobian_equals_finite_differences(seed: int) -> None:
    measurement = gps_velocity(GpsVelocity("doppler", 7, 1.0, 2.0, 0.04, 0.09), DOPPLER)
    x: Floats = np.random.default_rng(seed).normal(size=LAYOUT.n)
    moved = 1e-6 * np.eye(LAYOUT.n)
    differences = (measurement.h(x + moved) - measurement.h(x - moved)).T / 2e-6
    assert measurement.jacobian(x) == pytest.approx(differences, abs=1e-6), f"seed={seed}"
    assert np.abs(differences[:, [*range(*ATTITUDE.indices(99)), *range(*VELOCITY.indices(99)), 11]]).max() > 0.1


def test_an_antenna_ahead_of_a_machine_that_turns_on_the_spot_moves_sideways() -> None:
    x = np.zeros(LAYOUT.n)
    x[YAW], x[RATE.start + 2] = math.pi / 2, 0.5  # faces north, turns to the left: the antenna moves west
    sensor = replace(DOPPLER, mount=Mount((2.0, 0.0, 3.0)))
    measurement = gps_velocity(GpsVelocity("doppler", 7, 0.0, 0.0, 0.04, 0.04), sensor)
    assert measurement.h(x[None])[0] == pytest.approx([-1.0, 0.0], abs=1e-12)


def test_a_stated_error_has_a_least_value_and_a_configured_one_counts_as_it_is() -> None:
    reading = GpsVelocity("doppler", 7, 1.0, 2.0, 1e-6, 0.09)
    assert np.diag(gps_velocity(reading, DOPPLER).R) == pytest.approx([MIN_STD_MPS**2, 0.09])
    configured = replace(DOPPLER, std={"velocity": 0.01})
    assert np.diag(gps_velocity(reading, configured).R) == pytest.approx([1e-4, 1e-4])
    assert gps_velocity(reading, replace(DOPPLER, gate_sigma=9.0)).gate_sigma == 9.0


# --- in the filter ---------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_it_holds_the_position_while_fixes_are_away_and_the_wheels_are_wrong() -> None:
    """A scale that is wrong by a tenth is outside of what the filter takes wheels for before it has seen them."""
    made = drive(LONG, WITH_DOPPLER)
    blind = silenced(larger_wheels(made.readings, 1.1), 20.0)
    alone = end_error_m(WITH_DOPPLER, made, blind)
    aided = end_error_m(WITH_DOPPLER, made, merged(blind, doppler(made)))
    assert aided < 1.0
    assert aided < 0.5 * alone


@pytest.mark.slow
def test_velocities_from_before_the_heading_is_known_are_used_once_it_is() -> None:
    made = drive(S_BEND, WITH_DOPPLER)
    velocities = doppler(made)
    located = localiser(WITH_DOPPLER, filter="ekf")
    located.run(merged(made.readings, velocities))
    used = located.counters["doppler_used"]
    assert used > 0.9 * len(velocities)  # the first ones lie before the first step
    assert used + located.counters["too_late"] + located.counters["duplicate"] >= len(velocities)


@pytest.mark.slow
def test_a_wrong_velocity_is_gated_and_counted() -> None:
    made = drive(S_BEND, WITH_DOPPLER)
    velocities = doppler(made)
    wrong = [replace(v, velocity_e_mps=v.velocity_e_mps + 20.0) if i % 10 == 9 else v for i, v in enumerate(velocities)]
    located = localiser(WITH_DOPPLER, filter="ekf")
    poses = located.run(merged(made.readings, wrong))
    assert located.counters["doppler_gated"] > 10
    assert math.dist((poses[-1].x_m, poses[-1].y_m), made.at(poses[-1].stamp_ns)[:2]) < 0.3


def test_without_a_fix_and_without_a_start_there_is_no_pose_and_with_a_start_there_is() -> None:
    made = drive((Leg(4, 0.5), Leg(6)), WITH_DOPPLER, without=("gps-1",))
    readings = merged(made.readings, doppler(made))
    assert localiser(WITH_DOPPLER, filter="ekf").run(readings) == []
    located = localiser(WITH_DOPPLER, filter="ekf", start=START)
    pose = located.run(readings)[-1]
    assert math.dist((pose.x_m, pose.y_m), made.at(pose.stamp_ns)[:2]) < 0.5
    assert located.belief
    assert located.belief.x[SPEED] == pytest.approx(2.0, abs=0.05)
    assert pose.stamp_ns > START_NS
