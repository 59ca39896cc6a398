import math
from dataclasses import fields

import numpy as np
import pytest

from protocol.machine.machine_config import BASE, FRONT, Mount
from sim.state import FleetState
from tests.unit.sim.sensor_rigs import (
    DGPS,
    GRAVITY_MPS2,
    LOADER,
    SEED,
    check_deviation,
    errors,
    groups,
    noisy,
    perfect,
    rig,
    still,
    values,
)

N = 500


# --- IMU -------------------------------------------------------------------------------------------------------------


def test_imu_scale_and_mounting_errors() -> None:
    check_deviation(errors(noisy("imu", scale=0.002), "imu", 0.01, 2 * N)[0, :, 5] / GRAVITY_MPS2, 0.002, 2 * N)
    tilted = errors(noisy("imu", mounting_deg=1.0), "imu", 0.01, 2 * N)[0, :, 3:] / GRAVITY_MPS2
    check_deviation(tilted[:, :2], math.radians(1.0), 4 * N)
    np.testing.assert_allclose(np.hypot(tilted[:, 0], tilted[:, 1]) ** 2 + (1 + tilted[:, 2]) ** 2, 1.0)


@pytest.mark.parametrize(("speed", "share"), [(0.0, 0.0), (0.25, 0.5), (-0.5, 1.0), (4.0, 1.0)])
def test_imu_shakes_while_driving(speed: float, share: float) -> None:
    preset = noisy("imu", force_white_mps2=0.08, force_vibration_mps2=0.3, vibration_speed_mps=0.5)
    seen = errors(preset, "imu", 0.1, N, speed_mps=speed)
    check_deviation(seen[..., 3:], math.hypot(0.08, 0.3 * share), seen[..., 3:].size)
    np.testing.assert_allclose(seen[..., :3], 0.0, atol=1e-12)


def rotation(roll: float, pitch: float, yaw: float) -> np.ndarray:
    return Mount(rpy_deg=tuple(np.degrees([roll, pitch, yaw]))).frame_from_sensor()


def place(t: float) -> tuple[np.ndarray, np.ndarray]:
    """Pose of `base_link` on a synthetic track."""
    at = np.array([3 * math.sin(0.5 * t), 2 * t - 0.3 * t**2, 0.2 * math.cos(2 * t)])
    return at, rotation(0.2 * math.sin(2 * t), -0.1 + 0.15 * math.cos(3 * t), 0.4 * t + 0.2 * math.sin(t))


def angle(t: float) -> float:
    return 0.5 * math.sin(1.3 * t)


def sensor_place(t: float, number: int) -> tuple[np.ndarray, np.ndarray]:
    frame, mount = LOADER.imu_mounts()[number - 1]
    at, turn = place(t)
    if frame == FRONT:
        at, turn = at + turn @ LOADER.robot.place(FRONT, BASE).xyz_m, turn @ rotation(0, 0, angle(t))
    return at + turn @ mount.xyz_m, turn @ mount.frame_from_sensor()


def rate_and_force(pose: object, t: float, h: float = 1e-3) -> tuple[np.ndarray, np.ndarray]:
    """Angular rate and specific force by finite differences."""
    (before, r0), (now, r1), (after, r2) = (pose(t + d) for d in (-h, 0.0, h))  # type: ignore[operator]
    spin = r1.T @ (r2 - r0) / (2 * h)
    force = r1.T @ ((after - 2 * now + before) / h**2 + [0, 0, GRAVITY_MPS2])
    return np.array([spin[2, 1], spin[0, 2], spin[1, 0]]), force


@pytest.mark.parametrize("number", [1, 2, 3, 4])
@pytest.mark.parametrize("t", [0.3, 1.1])
def test_imus_on_both_frames_agree_with_finite_differences(number: int, t: float) -> None:
    h = 1e-3
    rates, force = rate_and_force(place, t)
    state = {
        "rates_radps": rates,
        "rates_dot_radps2": (rate_and_force(place, t + h)[0] - rate_and_force(place, t - h)[0]) / (2 * h),
        "force_mps2": force,
        "articulation_rad": angle(t),
        "articulation_radps": (angle(t + h) - angle(t - h)) / (2 * h),
        "articulation_radps2": (angle(t + h) - 2 * angle(t) + angle(t - h)) / h**2,
    }
    reading = values(rig(perfect(), imu=(number,), only="imu"), "imu", 0.01, **state)[0, 0]
    np.testing.assert_allclose(reading, np.concatenate(rate_and_force(lambda s: sensor_place(s, number), t)), atol=1e-4)


# --- attitude --------------------------------------------------------------------------------------------------------


def turned(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Vector part of q v q*."""
    xyz, w = q[:3], q[3]
    return v + 2 * w * np.cross(xyz, v) + 2 * np.cross(xyz, np.cross(xyz, v))


@pytest.mark.parametrize("number", [1, 2, 3, 4])
def test_attitude_turns_vectors_of_the_sensor_into_map(number: int) -> None:
    frame, mount = LOADER.imu_mounts()[number - 1]
    yaw, pitch, roll, bend = 2.0, -0.3, 0.1, 0.4
    state = {"yaw_rad": yaw, "pitch_rad": pitch, "roll_rad": roll, "articulation_rad": bend}
    q = values(rig(perfect(), attitude=(number,), only="attitude"), "attitude", 0.02, **state)[0, 0, :4]
    map_from_sensor = rotation(roll, pitch, yaw) @ rotation(0, 0, bend if frame == FRONT else 0)
    map_from_sensor = map_from_sensor @ mount.frame_from_sensor()
    for vector in np.eye(3):
        np.testing.assert_allclose(turned(q, vector), map_from_sensor @ vector, atol=1e-8)
    assert np.linalg.norm(q) == pytest.approx(1.0)


def test_attitude_states_the_variances_of_its_errors() -> None:
    stated = values(rig(DGPS, attitude=(3,), only="attitude"), "attitude", 0.02)[0, 0, 4:]
    tilt = math.radians(1) ** 2 * (0.4**2 + 0.1**2)
    assert stated == pytest.approx([tilt, tilt, math.radians(1) ** 2 * (1.5**2 + 1.0**2 + 0.3**2)])
    seen = errors(DGPS, "attitude", 0.02, 4 * N)
    for axis in range(3):
        check_deviation(seen[..., axis], math.sqrt(stated[axis]), 4 * N)


def test_no_reading_writes_into_the_states() -> None:
    state = still(20, 2)
    copies = FleetState(*(np.array(getattr(state, f.name)) for f in fields(FleetState)))
    groups([rig(DGPS, gps=(1, 2), imu=(1, 3), attitude=(1, 3))] * 2, copies, SEED)
    for f in fields(FleetState):
        np.testing.assert_array_equal(getattr(copies, f.name), getattr(state, f.name))
