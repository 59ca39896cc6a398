"""Motion of articulated wheel loaders, for all machines at once (numpy, no PyBullet).

Kinematics of two frames joined half-way between the axles; along the way, drive force against rolling resistance,
gravity and the inertia of the body and its wheels. The rear axle oscillates, so the body rests on three points: the
rear axle's centre and the two front wheels; their plane is its attitude once the tyres have settled.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from protocol.arrays import Floats, Ints
from sim.frames import body_rates, up_in_base
from sim.soil import C_RR, SLIP_STIFFNESS, TRACTION
from sim.terrain import Terrain
from sim.world import FleetState

GRAVITY = 9.80665
AXLE_TO_JOINT_M = 1.65
WHEELBASE_M = 2 * AXLE_TO_JOINT_M
HALF_TRACK_M = 1.1
CENTRE_HEIGHT_M = 1.05
FRONT_SHARE = 0.4317  # of the weight on the level
WHEEL_INERTIA_KG = 0.07 * 17_500.0  # of the four wheels, as mass at their rim
STEER_RADPS, STEER_GAIN = 0.35, 3.0  # the hydraulics' limit, and how hard they close in on the target
ENGINE_LAG_S = 0.15
TRACTION_USE = 0.98  # a wheel at its peak would spin up
STANDSTILL_MPS = 0.03  # rolling resistance fades in over this speed
BODY_RADPS, BODY_DAMPING = 12.0, 0.7  # the body on its tyres


@dataclass(frozen=True)
class Bodies:
    """What differs between the machines: true mass [kg] and true wheel radius [m], both (n,)."""

    mass_kg: Floats
    wheel_radius_m: Floats


@dataclass(frozen=True, slots=True)
class Contact:
    """The ground under machines: height below the rear axle, gradient of the wheels' plane, zones of the wheels.

    zones: (4, n), front left, front right, rear left, rear right.
    """

    z_m: Floats
    grade_e: Floats
    grade_n: Floats
    zones: Ints


def touch(terrain: Terrain, x_m: Floats, y_m: Floats, yaw_rad: Floats, articulation_rad: Floats) -> Contact:
    """Look up the ground under the wheels of machines."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    front = yaw_rad + articulation_rad
    cf, sf = np.cos(front), np.sin(front)
    ahead_x, ahead_y = AXLE_TO_JOINT_M * (c + cf), AXLE_TO_JOINT_M * (s + sf)
    half_x, half_y = -HALF_TRACK_M * sf, HALF_TRACK_M * cf
    rear_x, rear_y = -HALF_TRACK_M * s, HALF_TRACK_M * c
    wheels_x = x_m + np.array([ahead_x + half_x, ahead_x - half_x, rear_x, -rear_x])
    wheels_y = y_m + np.array([ahead_y + half_y, ahead_y - half_y, rear_y, -rear_y])
    left, right, rear_left, rear_right = terrain.height(wheels_x, wheels_y)
    z = 0.5 * (rear_left + rear_right)
    rise_ahead, rise_left = 0.5 * (left + right) - z, 0.5 * (left - right)
    area = ahead_x * half_y - ahead_y * half_x
    grade_e = (rise_ahead * half_y - rise_left * ahead_y) / area
    grade_n = (rise_left * ahead_x - rise_ahead * half_x) / area
    return Contact(z, grade_e, grade_n, terrain.zone(wheels_x, wheels_y))


def standing(bodies: Bodies, terrain: Terrain, x_m: Floats, y_m: Floats, yaw_rad: Floats) -> FleetState:
    """Machines at rest, straight, with no drive force."""
    zero, pair, triple = np.zeros_like(x_m), np.zeros((len(x_m), 2)), np.zeros((len(x_m), 3))
    ground = touch(terrain, x_m, y_m, yaw_rad, zero)
    pitch, roll, _ = _settled(ground, yaw_rad)
    return FleetState(
        x_m=x_m,
        y_m=y_m,
        z_m=ground.z_m,
        yaw_rad=yaw_rad,
        pitch_rad=pitch,
        roll_rad=roll,
        speed_mps=zero,
        accel_mps2=zero,
        pitch_radps=zero,
        roll_radps=zero,
        rates_radps=triple,
        rates_dot_radps2=triple,
        force_mps2=GRAVITY * up_in_base(pitch, roll),
        articulation_rad=zero,
        drive_n=zero,
        torque_nm=zero,
        load_n=bodies.mass_kg * GRAVITY,
        wheel_radps=pair,
        wheel_rad=pair,
        c_rr=zero,
        grade_e=ground.grade_e,
        grade_n=ground.grade_n,
    )


def advance(
    bodies: Bodies, terrain: Terrain, old: FleetState, steer_rad: Floats, drive_n: Floats, dt: float
) -> FleetState:
    """Advance machines by one step towards the driver's articulation [rad] and drive force [N]."""
    # Move, then look up the ground at the new place and the forces there.
    moved = _move(old, steer_rad, dt)
    ground = touch(terrain, moved.x_m, moved.y_m, moved.yaw_rad, moved.articulation_rad)
    settled_pitch, settled_roll, sin_up = _settled(ground, moved.yaw_rad)
    wheel_loads = loads(bodies, ground, sin_up, old.accel_mps2)
    load = wheel_loads.sum(axis=0)
    c_rr = (C_RR[ground.zones] * wheel_loads).sum(axis=0) / load
    traction = (TRACTION[ground.zones] * wheel_loads).sum(axis=0)

    # Forces along the way; the engine follows with a lag.
    drive = old.drive_n + (drive_n - old.drive_n) * (dt / ENGINE_LAG_S)
    drive = np.minimum(np.maximum(drive, -TRACTION_USE * traction), TRACTION_USE * traction)
    resistance = c_rr * load * np.tanh(moved.speed_mps / STANDSTILL_MPS)
    weight_back = bodies.mass_kg * GRAVITY * sin_up
    accel = (drive - resistance - weight_back) / (bodies.mass_kg + WHEEL_INERTIA_KG)

    # The body swings on its tyres; the wheels turn faster than the machine moves.
    pitch, pitching = _swing(old.pitch_rad, old.pitch_radps, settled_pitch, dt)
    roll, rolling = _swing(old.roll_rad, old.roll_radps, settled_roll, dt)
    rates = body_rates(moved.turning_radps, pitching, rolling, pitch, roll)
    stiffness = (SLIP_STIFFNESS[ground.zones] * wheel_loads).sum(axis=0)
    faster = wheel_ratio(drive, traction, stiffness) / bodies.wheel_radius_m
    sides = moved.speed_mps[:, None] + moved.turning_radps[:, None] * np.array([-HALF_TRACK_M, HALF_TRACK_M])
    wheel = sides * faster[:, None]
    return FleetState(
        x_m=moved.x_m,
        y_m=moved.y_m,
        z_m=ground.z_m,
        yaw_rad=moved.yaw_rad,
        pitch_rad=pitch,
        roll_rad=roll,
        speed_mps=moved.speed_mps,
        accel_mps2=accel,
        pitch_radps=pitching,
        roll_radps=rolling,
        rates_radps=rates,
        rates_dot_radps2=(rates - old.rates_radps) / dt,
        force_mps2=_specific_force(moved.speed_mps, accel, rates, pitch, roll),
        articulation_rad=moved.articulation_rad,
        drive_n=drive,
        torque_nm=drive * bodies.wheel_radius_m,
        load_n=load,
        wheel_radps=wheel,
        wheel_rad=old.wheel_rad + dt * wheel,
        c_rr=c_rr,
        grade_e=ground.grade_e,
        grade_n=ground.grade_n,
    )


@dataclass(frozen=True, slots=True)
class _Moved:
    """Where machines are after a step, and how fast they move and turn; all (n,)."""

    x_m: Floats
    y_m: Floats
    yaw_rad: Floats
    articulation_rad: Floats
    speed_mps: Floats
    turning_radps: Floats


def _move(old: FleetState, steer_rad: Floats, dt: float) -> _Moved:
    """Kinematics of the two frames: neither axle slides sideways."""
    steering = np.minimum(np.maximum((steer_rad - old.articulation_rad) * STEER_GAIN, -STEER_RADPS), STEER_RADPS)
    articulation = old.articulation_rad + dt * steering
    speed = old.speed_mps + dt * old.accel_mps2
    sideways = speed * np.sin(articulation) - AXLE_TO_JOINT_M * steering
    turning = sideways / (AXLE_TO_JOINT_M * (1 + np.cos(articulation)))
    level = dt * speed * np.cos(old.pitch_rad)
    heading = old.yaw_rad + 0.5 * dt * turning
    x, y = old.x_m + level * np.cos(heading), old.y_m + level * np.sin(heading)
    return _Moved(x, y, old.yaw_rad + dt * turning, articulation, speed, turning)


def _specific_force(speed: Floats, accel: Floats, rates: Floats, pitch: Floats, roll: Floats) -> Floats:
    """What an accelerometer at `base_link` feels (n, 3): d/dt v + w x v of the velocity (speed, 0, 0), less gravity."""
    moving = np.stack([accel, speed * rates[:, 2], -speed * rates[:, 1]], axis=-1)
    return moving + GRAVITY * up_in_base(pitch, roll)


def loads(bodies: Bodies, ground: Contact, sin_up: Floats, accel_mps2: Floats) -> Floats:
    """Loads of the wheels (4, n) [N]: the ground's normal force, shifted to the rear uphill and under power."""
    normal = bodies.mass_kg * GRAVITY / np.sqrt(1 + ground.grade_e**2 + ground.grade_n**2)
    shift = bodies.mass_kg * (GRAVITY * sin_up + accel_mps2) * (CENTRE_HEIGHT_M / WHEELBASE_M)
    front = np.minimum(np.maximum(FRONT_SHARE * normal - shift, 0.0), normal)
    rear = normal - front
    return 0.5 * np.array([front, front, rear, rear])


def wheel_ratio(drive_n: Floats, traction_n: Floats, stiffness_n: Floats) -> Floats:
    """Wheel speed over ground speed: slip rises with the drive force, steeply near the traction limit."""
    slip = np.arctanh(drive_n / traction_n) * traction_n / stiffness_n
    # slip refers to the faster of wheel and ground: driving v = wheel (1 - slip), braking wheel = v (1 - |slip|)
    bounded = np.minimum(np.abs(slip), 0.9)
    return np.where(slip >= 0, 1 / (1 - bounded), 1 - bounded)


def _settled(ground: Contact, yaw_rad: Floats) -> tuple[Floats, Floats, Floats]:
    """Pitch and roll of a body resting on the ground, and the sine of the climb straight ahead."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    ahead = ground.grade_e * c + ground.grade_n * s
    left = ground.grade_n * c - ground.grade_e * s
    slope = 1 + ahead**2
    return -np.arctan(ahead), np.arcsin(left / np.sqrt(slope + left**2)), ahead / np.sqrt(slope)


def _swing(angle: Floats, rate: Floats, target: Floats, dt: float) -> tuple[Floats, Floats]:
    """One step of a damped oscillator towards the target."""
    rate = rate + dt * (BODY_RADPS**2 * (target - angle) - 2 * BODY_DAMPING * BODY_RADPS * rate)
    return angle + dt * rate, rate
