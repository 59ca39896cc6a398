"""Scenes: points on rigid frames and the ground under their wheels. Two scenes one step apart give a state."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from protocol.arrays import Floats, Ints
from protocol.units import GRAVITY_MPS2
from sim.state import STEP_S, FleetState
from sim.terrain.terrain import C_RR, Terrain
from sim.worlds.bullet_client import Frames

# Tracked points and their frames: hubs, `base_link`.
HUBS, BASE_POINT = slice(0, 4), 4
POINT_FRAME = [1, 1, 2, 2, 0]
_GRAVITY_UP = np.array([0.0, 0.0, GRAVITY_MPS2])
_LEVI_CIVITA = np.zeros((3, 9))
for _i, _j, _k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
    _LEVI_CIVITA[_j, 3 * _i + _k] = 1.0
    _LEVI_CIVITA[_j, 3 * _k + _i] = -1.0


@dataclass(frozen=True, slots=True)
class Points:
    """Position and velocity of machine points, (n, 5, 3) in `map`."""

    xyz_m: Floats
    velocity_mps: Floats


@dataclass(frozen=True, slots=True)
class WheelGround:
    """Wheel contacts; arrays (n, 4, ...).

    point_m: ground point nearest to the hub. wheel_from_map: rows ahead, left, up there. gap_m: hub to ground.
    velocity: of the hub along the rows.
    """

    point_m: Floats
    wheel_from_map: Floats
    gap_m: Floats
    velocity_mps: Floats
    zone: Ints


@dataclass(frozen=True, slots=True)
class BodyScene:
    """Frames, points and ground at one instant."""

    frames: Frames
    points: Points
    ground: WheelGround


class DriveTrain(NamedTuple):
    """Over one step: drive force, torque of all wheels; spin and angle of the rear wheels (n, 2)."""

    drive_n: Floats
    torque_nm: Floats
    wheel_radps: Floats
    wheel_rad: Floats


class Weights(NamedTuple):
    """Mass with payload, and of the payload alone, both (n,)."""

    mass_kg: Floats
    payload_kg: Floats


def scene_at(terrain: Terrain, frames: Frames, arms_m: Floats, guess_m: Floats | None = None) -> BodyScene:
    """Points and wheel contacts of frames. guess_m: previous ground points."""
    points = points_on(frames, arms_m)
    guess = points.xyz_m[:, HUBS] if guess_m is None else guess_m
    return BodyScene(frames, points, ground_under(terrain, frames, points, guess))


def cross(a: Floats, b: Floats) -> Floats:
    """Cross product along the last axis; numpy's takes ten times as long for a few machines."""
    matrix = (a @ _LEVI_CIVITA).reshape(*a.shape[:-1], 3, 3)
    product: Floats = (matrix @ b[..., None])[..., 0]
    return product


def points_on(frames: Frames, arms_m: Floats) -> Points:
    """Points at arms_m (n, 5, 3) from their frame's centre of mass, along its axes."""
    arms = (frames.rotation[:, POINT_FRAME] @ arms_m[..., None])[..., 0]
    turning = cross(frames.rate_radps[:, POINT_FRAME], arms)
    return Points(frames.centre_m[:, POINT_FRAME] + arms, frames.velocity_mps[:, POINT_FRAME] + turning)


def ground_under(terrain: Terrain, frames: Frames, points: Points, guess_m: Floats) -> WheelGround:
    """Ground under wheels. guess_m: previous ground points, which move little per step."""
    x, y = guess_m[..., 0], guess_m[..., 1]
    height, east, north = terrain.surface(x, y)
    hub = points.xyz_m[:, HUBS]

    up = np.empty_like(hub)
    up[..., 0], up[..., 1], up[..., 2] = -east, -north, 1.0
    up /= np.sqrt(np.vecdot(up, up))[..., None]
    above = hub - guess_m
    above[..., 2] = hub[..., 2] - height
    gap = np.vecdot(above, up)

    axle = frames.rotation[:, POINT_FRAME[HUBS]][..., 1]
    ahead = cross(axle, up)
    ahead /= np.sqrt(np.vecdot(ahead, ahead))[..., None]
    axes = np.stack([ahead, cross(up, ahead), up], axis=-2)
    velocity = (axes @ points.velocity_mps[:, HUBS, :, None])[..., 0]
    return WheelGround(hub - gap[..., None] * up, axes, gap, velocity, terrain.zone(x, y))


def attitude(rotation: Floats) -> tuple[Floats, Floats, Floats]:
    """Yaw, pitch (nose down) and roll of rotations (n, 3, 3)."""
    yaw = np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0])
    roll = np.arctan2(rotation[:, 2, 1], rotation[:, 2, 2])
    return yaw, -np.arcsin(rotation[:, 2, 0]), roll


def plane_gradient(points_m: Floats) -> tuple[Floats, Floats]:
    """Gradient, east and north, of the plane through four wheel points (n, 4, 3)."""
    ahead = points_m[:, 0] + points_m[:, 1] - points_m[:, 2] - points_m[:, 3]
    left = points_m[:, 0] - points_m[:, 1] + points_m[:, 2] - points_m[:, 3]
    normal = cross(ahead, left)
    return -normal[:, 0] / normal[:, 2], -normal[:, 1] / normal[:, 2]


def articulation(rotation: Floats) -> Floats:
    """Angle (n,) from rear to front frame about the rear's upright axis; rotation (n, frames, 3, 3)."""
    front, rear = rotation[:, 1, :, 0], rotation[:, 0]
    angle: Floats = np.arctan2(np.vecdot(front, rear[:, :, 1]), np.vecdot(front, rear[:, :, 0]))
    return angle


def state_from_scenes(
    before: BodyScene, now: BodyScene, load_n: Floats, weights: Weights, drive: DriveTrain
) -> FleetState:
    """State of machines from two scenes. load_n: per wheel, (n, 4).

    Accelerations are means over the step, like an accelerometer's over its interval.
    """
    rates, rates_dot, force = _inertial(before, now)
    yaw, pitch, roll = attitude(now.frames.rotation[:, 0])
    cosine, sine, tangent = np.cos(roll), np.sin(roll), np.tan(pitch)
    speed, bending = _speed(now), _bending(now)
    load = load_n.sum(axis=-1)
    grade_e, grade_n = plane_gradient(now.ground.point_m)
    about_x, about_y, about_z = rates.T
    x, y, z = now.points.xyz_m[:, BASE_POINT].T
    return FleetState(
        x_m=x,
        y_m=y,
        z_m=z,
        yaw_rad=yaw,
        pitch_rad=pitch,
        roll_rad=roll,
        speed_mps=speed,
        accel_mps2=(speed - _speed(before)) / STEP_S,
        pitch_radps=about_y * cosine - about_z * sine,
        roll_radps=about_x + (about_y * sine + about_z * cosine) * tangent,
        rates_radps=rates,
        rates_dot_radps2=rates_dot,
        force_mps2=force,
        articulation_rad=articulation(now.frames.rotation),
        articulation_radps=bending,
        articulation_radps2=(bending - _bending(before)) / STEP_S,
        load_n=load,
        c_rr=(C_RR[now.ground.zone] * load_n).sum(axis=-1) / np.maximum(load, 1.0),
        grade_e=grade_e,
        grade_n=grade_n,
        **weights._asdict(),
        **drive._asdict(),
    )


def _inertial(before: BodyScene, now: BodyScene) -> tuple[Floats, Floats, Floats]:
    """Angular rate, its derivative and specific force at `base_link`, each (n, 3) in its axes."""
    old_rates, rates = _in_base(before.frames.rate_radps[:, 0], before), _in_base(now.frames.rate_radps[:, 0], now)
    change_mps = now.points.velocity_mps[:, BASE_POINT] - before.points.velocity_mps[:, BASE_POINT]
    force = change_mps / STEP_S + _GRAVITY_UP
    return rates, (rates - old_rates) / STEP_S, _in_base(force, now)


def _in_base(vector: Floats, scene: BodyScene) -> Floats:
    turned: Floats = (vector[:, None, :] @ scene.frames.rotation[:, 0])[:, 0]
    return turned


def _speed(scene: BodyScene) -> Floats:
    speed: Floats = np.vecdot(scene.points.velocity_mps[:, BASE_POINT], scene.frames.rotation[:, 0, :, 0])
    return speed


def _bending(scene: BodyScene) -> Floats:
    rate = scene.frames.rate_radps
    bending: Floats = np.vecdot(rate[:, 1] - rate[:, 0], scene.frames.rotation[:, 0, :, 2])
    return bending
