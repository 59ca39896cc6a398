"""What a world of rigid bodies looks like to sensors: the state record from two scenes, one step apart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from protocol.arrays import Floats
from sim.rigid import ORIGINS, Scene, articulation, attitude, plane_gradient
from sim.soil import C_RR
from sim.vehicle import GRAVITY
from sim.world import STEP_S, FleetState

_GRAVITY_UP = np.array([0.0, 0.0, GRAVITY])


@dataclass(frozen=True, slots=True)
class Drive:
    """What the drive train did: drive force, torque of all wheels together; spin and angle of the rear ones (n, 2)."""

    drive_n: Floats
    torque_nm: Floats
    wheel_radps: Floats
    wheel_rad: Floats


@dataclass(frozen=True, slots=True)
class FrontState:
    """Front frames, arrays (n, 3) in `front_link`: angular rate, its derivative, specific force at the joint."""

    rates_radps: Floats
    rates_dot_radps2: Floats
    force_mps2: Floats


def observe(before: Scene, now: Scene, load_n: Floats, drive: Drive) -> tuple[FleetState, FrontState]:
    """Read off the state of machines. load_n: of each wheel, (n, 4).

    Accelerations are differences over the step, as an accelerometer that averages over its interval has them.
    """
    rates, rates_dot, force = _inertial(before, now)
    base = now.frames.rotation[:, 0]
    yaw, pitch, roll = attitude(base)
    cosine, sine, tangent = np.cos(roll), np.sin(roll), np.tan(pitch)
    speed, old_speed = _speed(now), _speed(before)
    load = load_n.sum(axis=-1)
    grade_e, grade_n = plane_gradient(now.ground.point_m)
    about_x, about_y, about_z = rates[:, 0].T
    x, y, z = now.points.xyz_m[:, ORIGINS.start].T
    state = FleetState(
        x_m=x,
        y_m=y,
        z_m=z,
        yaw_rad=yaw,
        pitch_rad=pitch,
        roll_rad=roll,
        speed_mps=speed,
        accel_mps2=(speed - old_speed) / STEP_S,
        pitch_radps=about_y * cosine - about_z * sine,
        roll_radps=about_x + (about_y * sine + about_z * cosine) * tangent,
        rates_radps=rates[:, 0],
        rates_dot_radps2=rates_dot[:, 0],
        force_mps2=force[:, 0],
        articulation_rad=articulation(now.frames.rotation),
        drive_n=drive.drive_n,
        torque_nm=drive.torque_nm,
        load_n=load,
        wheel_radps=drive.wheel_radps,
        wheel_rad=drive.wheel_rad,
        c_rr=(C_RR[now.ground.zone] * load_n).sum(axis=-1) / np.maximum(load, 1.0),
        grade_e=grade_e,
        grade_n=grade_n,
    )
    return state, FrontState(rates[:, 1], rates_dot[:, 1], force[:, 1])


def _inertial(before: Scene, now: Scene) -> tuple[Floats, Floats, Floats]:
    """Rate, its derivative, and specific force at the origins of rear and front frame, each (n, 2, 3) in its axes."""
    old_rates, rates = _own_rates(before), _own_rates(now)
    change = now.points.velocity_mps[:, ORIGINS] - before.points.velocity_mps[:, ORIGINS]
    feels = change / STEP_S + _GRAVITY_UP
    force = (feels[..., None, :] @ now.frames.rotation[:, :2])[..., 0, :]
    return rates, (rates - old_rates) / STEP_S, force


def _own_rates(scene: Scene) -> Floats:
    rates: Floats = (scene.frames.rate_radps[:, :2, None, :] @ scene.frames.rotation[:, :2])[..., 0, :]
    return rates


def _speed(scene: Scene) -> Floats:
    speed: Floats = np.vecdot(scene.points.velocity_mps[:, ORIGINS.start], scene.frames.rotation[:, 0, :, 0])
    return speed
