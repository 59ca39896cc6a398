"""Velocity by Doppler: its model, and what it changes in the filter."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from agents.localisation.filters.state import SPEED
from agents.localisation.gps_velocity import MIN_STD_MPS, gps_velocity
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
    thinned,
)

DOPPLER = SensorConfig("doppler", "gps_velocity", Mount(LEVER_M))
WITH_DOPPLER = replace(VEHICLE, sensors=(*VEHICLE.sensors, DOPPLER))
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
    blind = silenced(larger_wheels(thinned(made.readings), 1.1), 20.0)
    alone = end_error_m(WITH_DOPPLER, made, blind)
    aided = end_error_m(WITH_DOPPLER, made, merged(blind, doppler(made)))
    assert aided < 1.0
    assert aided < 0.5 * alone


def test_without_a_fix_and_without_a_start_there_is_no_pose_and_with_a_start_there_is() -> None:
    made = drive((Leg(4, 0.5), Leg(6)), WITH_DOPPLER, without=("gps-1",))
    readings = merged(made.readings, doppler(made))
    assert localiser(WITH_DOPPLER, filter="ekf").run(readings) == []
    located = localiser(WITH_DOPPLER, filter="ekf", start=START)
    pose = located.run(readings)[-1]
    assert math.dist((pose.x_m, pose.y_m), made.at(pose.stamp_ns)[:2]) < 0.5
    assert located.belief.x[SPEED] == pytest.approx(2.0, abs=0.05)
    assert pose.stamp_ns > START_NS
