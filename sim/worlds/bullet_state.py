"""The state of machines in the PyBullet world, from two scenes one step apart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from protocol.arrays import Floats
from protocol.units import GRAVITY_MPS2
from sim.state import STEP_S, FleetState
from sim.terrain.soil import C_RR
from sim.worlds.bullet_scene import BASE_POINT, BodyScene, articulation, attitude, plane_gradient

_GRAVITY_UP = np.array([0.0, 0.0, GRAVITY_MPS2])


@dataclass(frozen=True, slots=True)
class DriveTrain:
    """Drive train over one step: drive force, torque of all wheels together; spin and angle of the rear ones (n, 2)."""

    drive_n: Floats
    torque_nm: Floats
    wheel_radps: Floats
    wheel_rad: Floats


@dataclass(frozen=True, slots=True)
class Weights:
    """Mass of machines with their payload, and of the payload alone, both (n,)."""

    mass_kg: Floats
    payload_kg: Floats


def state_from_scenes(
    before: BodyScene, now: BodyScene, load_n: Floats, weights: Weights, drive: DriveTrain
) -> FleetState:
    """The state of machines. load_n: of each wheel, (n, 4).

    Accelerations are differences over the step, as an accelerometer that averages over its interval has them.
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
        drive_n=drive.drive_n,
        torque_nm=drive.torque_nm,
        load_n=load,
        mass_kg=weights.mass_kg,
        payload_kg=weights.payload_kg,
        wheel_radps=drive.wheel_radps,
        wheel_rad=drive.wheel_rad,
        c_rr=(C_RR[now.ground.zone] * load_n).sum(axis=-1) / np.maximum(load, 1.0),
        grade_e=grade_e,
        grade_n=grade_n,
    )


def _inertial(before: BodyScene, now: BodyScene) -> tuple[Floats, Floats, Floats]:
    """Rate, its derivative, and specific force at `base_link`, each (n, 3) in its axes."""
    old_rates, rates = _in_base(before.frames.rate_radps[:, 0], before), _in_base(now.frames.rate_radps[:, 0], now)
    change_mps = now.points.velocity_mps[:, BASE_POINT] - before.points.velocity_mps[:, BASE_POINT]
    force = change_mps / STEP_S + _GRAVITY_UP
    return rates, (rates - old_rates) / STEP_S, _in_base(force, now)


def _in_base(vector: Floats, scene: BodyScene) -> Floats:
    """Vectors (n, 3) of `map` along the axes of `base_link`."""
    turned: Floats = (vector[:, None, :] @ scene.frames.rotation[:, 0])[:, 0]
    return turned


def _speed(scene: BodyScene) -> Floats:
    speed: Floats = np.vecdot(scene.points.velocity_mps[:, BASE_POINT], scene.frames.rotation[:, 0, :, 0])
    return speed


def _bending(scene: BodyScene) -> Floats:
    """Rate of the joint's angle."""
    rate = scene.frames.rate_radps
    bending: Floats = np.vecdot(rate[:, 1] - rate[:, 0], scene.frames.rotation[:, 0, :, 2])
    return bending
