"""One step of the fast world, compiled by numba.

numba's cache only sees changes in the called function's own file: constants of other modules are passed in, and this
file must be touched after a change in `terrain/terrain.py`.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numba
import numpy as np

from protocol.arrays import Floats, Table
from sim.terrain.terrain import TerrainGrid, surface, zone

_compiled = numba.njit(cache=True, inline="always", error_model="numpy")
Record = Any  # a record of `fast.STATE` or `fast.MACHINE`, fields as attributes


class Constants(NamedTuple):
    """Constants of other modules."""

    dt_s: float
    gravity: float
    standstill_mps: float
    traction_use: float


class Moved(NamedTuple):
    """Pose and motion after a step."""

    x: float
    y: float
    yaw: float
    bend: float
    speed: float
    turning: float


class RearAxle(NamedTuple):
    """Rear axle's centre, rear frame's direction."""

    x: float
    y: float
    cos_yaw: float
    sin_yaw: float


class Contact(NamedTuple):
    """Ground under a machine.

    z: below the rear axle. slope: of the plane that carries the rear frame, in its axes. climb: mean slope under an
    axle's wheels, in their direction. grade: of the plane through all wheels, in `map`. zones: front left, front right,
    rear left, rear right.
    """

    z: float
    slope_ahead: float
    slope_left: float
    climb_front: float
    climb_rear: float
    grade_e: float
    grade_n: float
    zones: tuple[int, int, int, int]


class Rates(NamedTuple):
    """Motion of a machine.

    turning: of the rear frame. accel: of the body's centre, ahead; force_left: specific force; both from the last step.
    lifting, riding: acceleration and speed of the centre off the ground. pitch, pitching: nose down.
    """

    speed: float
    turning: float
    accel: float
    force_left: float
    lifting: float
    riding: float
    pitch: float
    pitching: float
    pitching_dot: float


class Forces(NamedTuple):
    """Forces along the track and their results.

    grip: drive force limit without wheel spin. tyres: force from drive and brakes. accel, centre: of `base_link` and of
    the body's centre. crab: side slip angle. wheel_ratio: wheel speed over ground speed.
    """

    load: float
    c_rr: float
    grip: float
    tyres: float
    accel: float
    centre: float
    crab: float
    wheel_ratio: float


@_compiled
def advance(
    k: Constants, soils: Floats, machines: Table, grid: TerrainGrid, old: Table, steering: Floats, drive: Floats,
    brake: Floats,
) -> Table:  # fmt: skip
    """Advance machines by one step.

    soils: resistance, traction and slip stiffness per zone, (3, zones). machines: MACHINE (n,). old: STATE (n,). The
    rest (n,): articulation rate, drive force, brake force limit.
    """
    new = np.empty_like(old)
    for i in range(old.size):
        # Move, then evaluate ground and forces there.
        m, before, now = machines[i], old[i], new[i]
        moved = _move(k.dt_s, m, before, steering[i])
        ground = _touch(m, grid, moved)
        _ride(k, m, ground, before, now)
        rates = Rates(
            speed=moved.speed,
            turning=moved.turning,
            accel=before.centre_mps2,
            force_left=before.force_mps2[1],
            lifting=(now.ride_mps - before.ride_mps) / k.dt_s + before.accel_mps2 * math.sin(now.pitch_aim_rad),
            riding=now.ride_mps,
            pitch=now.pitch_rad,
            pitching=now.pitch_radps,
            pitching_dot=(now.pitch_radps - before.pitch_radps) / k.dt_s,
        )
        forces = _forces(k, soils, m, ground, rates, drive[i], brake[i])

        now.x_m, now.y_m, now.yaw_rad = moved.x, moved.y, moved.yaw
        now.z_m = now.ride_m + m.front_share * (m.rear_to_joint_m + m.front_to_joint_m) * math.tan(now.pitch_rad)
        now.articulation_rad, now.articulation_radps = moved.bend, steering[i]
        now.articulation_radps2 = (steering[i] - before.articulation_radps) / k.dt_s
        now.speed_mps, now.accel_mps2, now.centre_mps2 = moved.speed, forces.accel, forces.centre
        now.drive_n, now.torque_nm, now.grip_n = drive[i], forces.tyres * m.wheel_radius_m, forces.grip
        now.load_n, now.c_rr, now.crab_rad = forces.load, forces.c_rr, forces.crab
        now.grade_e, now.grade_n = ground.grade_e, ground.grade_n
        _turn_wheels(k.dt_s, forces.wheel_ratio / m.wheel_radius_m, m.half_track_m, moved, before, now)
        _inertial(k, m, moved, rates, before, now)
    return new


@_compiled
def settle(machines: Table, grid: TerrainGrid, state: Table) -> None:
    """Place bodies, STATE (n,), at their equilibrium."""
    for i in range(state.size):
        m, now = machines[i], state[i]
        at = Moved(now.x_m, now.y_m, now.yaw_rad, now.articulation_rad, 0.0, 0.0)
        _aim(m, _touch(m, grid, at), now)
        now.ride_m, now.pitch_rad, now.roll_rad = now.ride_aim_m, now.pitch_aim_rad, now.roll_aim_rad


@_compiled
def _move(dt: float, m: Record, before: Record, steering: float) -> Moved:
    """No axle slips sideways.

    With arms L_r, L_f to the joint: (L_f + L_r cos g) dyaw/dt = v sin g - L_f dg/dt.
    """
    rear, front = m.rear_to_joint_m, m.front_to_joint_m
    bend, speed = before.articulation_rad + dt * steering, before.speed_mps + dt * before.accel_mps2
    turning = (speed * math.sin(bend) - front * steering) / (front + rear * math.cos(bend))
    level, heading = dt * speed * math.cos(before.pitch_aim_rad), before.yaw_rad + 0.5 * dt * turning + before.crab_rad
    x, y = before.x_m + level * math.cos(heading), before.y_m + level * math.sin(heading)
    return Moved(x, y, before.yaw_rad + dt * turning, bend, speed, turning)


@_compiled
def _touch(m: Record, grid: TerrainGrid, at: Moved) -> Contact:
    # From the rear axle's centre in the rear frame's axes: the front axle's centre, and its left half.
    bend = 0.0 if m.skid_grip > 0 else at.bend  # a rigid machine's joint only represents steering
    cf, sf = math.cos(bend), math.sin(bend)
    ahead_x = m.rear_to_joint_m + m.front_to_joint_m * cf
    ahead_y = m.front_to_joint_m * sf
    half = m.half_track_m
    left_x, left_y = -half * sf, half * cf

    c, s = math.cos(at.yaw), math.sin(at.yaw)
    rear_axle = RearAxle(at.x, at.y, c, s)
    fl, east_fl, north_fl, zone_fl = _under(grid, rear_axle, ahead_x + left_x, ahead_y + left_y)
    fr, east_fr, north_fr, zone_fr = _under(grid, rear_axle, ahead_x - left_x, ahead_y - left_y)
    rl, east_rl, north_rl, zone_rl = _under(grid, rear_axle, 0.0, half)
    rr, east_rr, north_rr, zone_rr = _under(grid, rear_axle, 0.0, -half)
    z = 0.5 * (rl + rr)
    rise, front, rear = 0.5 * (fl + fr) - z, 0.5 * (fl - fr), 0.5 * (rl - rr)

    if m.rolls_with_front:
        own_ahead, own_left = _plane(ahead_x, ahead_y, rise, left_x, left_y, front)
    else:
        own_ahead, own_left = _plane(ahead_x, ahead_y, rise, 0.0, half, rear)
    ahead, left = _plane(ahead_x, ahead_y, rise, left_x, left_y + half, front + rear)
    front_c, front_s = c * cf - s * sf, s * cf + c * sf
    climb_front = 0.5 * ((east_fl + east_fr) * front_c + (north_fl + north_fr) * front_s)
    climb_rear = 0.5 * ((east_rl + east_rr) * c + (north_rl + north_rr) * s)
    grade_e, grade_n = ahead * c - left * s, ahead * s + left * c
    under = (zone_fl, zone_fr, zone_rl, zone_rr)
    return Contact(z, own_ahead, own_left, climb_front, climb_rear, grade_e, grade_n, under)


@_compiled
def _under(grid: TerrainGrid, at: RearAxle, ahead: float, left: float) -> tuple[float, float, float, int]:
    """Height, slopes east and north, zone at a place relative to the rear axle's centre."""
    x, y = at.x + at.cos_yaw * ahead - at.sin_yaw * left, at.y + at.sin_yaw * ahead + at.cos_yaw * left
    height, east, north = surface(grid, x, y)
    return height, east, north, zone(grid, x, y)


@_compiled
def _plane(ax: float, ay: float, az: float, bx: float, by: float, bz: float) -> tuple[float, float]:
    """Slopes along x and y of the plane spanned by two vectors."""
    area = ax * by - ay * bx
    return (az * by - bz * ay) / area, (bz * ax - az * bx) / area


@_compiled
def _forces(
    k: Constants, soils: Floats, m: Record, ground: Contact, rates: Rates, drive: float, brake: float
) -> Forces:
    # Normal force, shifted to the rear uphill, under power and as the nose drops; then soil forces.
    speed, weight = rates.speed, m.mass_kg * k.gravity
    level = weight / math.sqrt(1 + ground.grade_e**2 + ground.grade_n**2)
    load = max(level + m.mass_kg * rates.lifting, 0.1 * level)
    pitched = weight * ground.slope_ahead / math.sqrt(1 + ground.slope_ahead**2)
    tilting = (pitched + m.mass_kg * rates.accel) * m.centre_height_m + m.pitch_inertia_kgm2 * rates.pitching_dot
    front = min(max(m.front_share * load - tilting / (m.rear_to_joint_m + m.front_to_joint_m), 0.0), load)
    nose_up = -rates.pitch
    climb = weight * math.sin(nose_up)
    climb += front * math.sin(math.atan(ground.climb_front) - nose_up)
    climb += (load - front) * math.sin(math.atan(ground.climb_rear) - nose_up)
    resistance = _borne(soils[0], ground.zones, front, load)
    traction = _borne(soils[1], ground.zones, front, load)
    stiffness = _borne(soils[2], ground.zones, front, load)

    # Brakes hold at most to standstill at the end of the next step. If the body pitches, `base_link` moves differently
    # from its centre: v' + q' h = F / m - q w.
    centre_mps = speed + rates.pitching * m.centre_height_m
    upward_mps = rates.riding * math.cos(nose_up) - centre_mps * math.sin(nose_up)
    tipping = m.mass_kg * (rates.pitching_dot * m.centre_height_m + rates.pitching * upward_mps)
    inertia = m.mass_kg + 4 * m.wheel_inertia_kgm2 / m.wheel_radius_m**2
    # Side force needs side slip; in a curve, v' = F / m + w v_left then slows the machine down.
    moving = math.tanh(speed / k.standstill_mps)
    crab = -m.mass_kg * rates.force_left / stiffness * moving
    drag = -m.mass_kg * rates.turning * speed * crab
    against = m.rolling * resistance * moving + drag + climb + tipping + _skidding(m, rates, load) * moving
    to_stop = inertia * speed / k.dt_s + drive - against
    most = k.traction_use * traction
    tyres = min(max(drive - min(max(to_stop, -brake), brake), -most), most)

    # Slip refers to the faster of wheel and ground. Driving: v = wheel (1 - slip). Braking: wheel = v (1 - slip).
    slower = 1 - math.atanh(abs(tyres) / traction) * traction / stiffness
    ratio = 1 / slower if tyres * speed > 0 else slower
    fl, fr, rl, rr = ground.zones
    least = min(min(soils[1, fl], soils[1, fr]), min(soils[1, rl], soils[1, rr]))
    grip, accel = k.traction_use * least * load, (tyres - against) / inertia
    return Forces(load, resistance / load, grip, tyres, accel, accel + tipping / m.mass_kg, crab, ratio)


@_compiled
def _skidding(m: Record, rates: Rates, load: float) -> float:
    """Resistance of a turn for wheels or tracks that slide sideways.

    End wheels slide by the angle L / (2 R). With side force over load mu, full from 0.1 rad, the turn takes a moment mu
    load L / 4; force = moment / R.
    """
    if m.skid_grip == 0.0:
        return 0.0
    length = m.rear_to_joint_m + m.front_to_joint_m
    curvature = abs(rates.turning) / max(abs(rates.speed), 0.1)
    force: float = m.skid_grip * load * 0.25 * length * curvature * min(0.5 * length * curvature / 0.1, 1.0)
    return force


@_compiled
def _borne(values: Floats, zones: tuple[int, int, int, int], front: float, load: float) -> float:
    """Sum of a soil value times wheel load; an axle's wheels share its load equally."""
    fl, fr, rl, rr = zones
    ahead, behind = values[fl] + values[fr], values[rl] + values[rr]
    total: float = 0.5 * (front * ahead + (load - front) * behind)
    return total


@_compiled
def _turn_wheels(dt: float, radps_per_mps: float, half_track: float, at: Moved, before: Record, now: Record) -> None:
    faster = at.turning * half_track
    now.wheel_radps[0], now.wheel_radps[1] = (at.speed - faster) * radps_per_mps, (at.speed + faster) * radps_per_mps
    for side in range(2):
        now.wheel_rad[side] = before.wheel_rad[side] + dt * now.wheel_radps[side]


@_compiled
def _aim(m: Record, ground: Contact, now: Record) -> None:
    """Equilibrium of the body, with the tyre deflection of the empty machine."""
    slope = math.sqrt(1 + ground.slope_ahead**2)
    now.pitch_aim_rad = -math.atan(ground.slope_ahead)
    now.roll_aim_rad = math.atan(ground.slope_left / slope)
    now.ride_aim_m = ground.z + m.front_share * (m.rear_to_joint_m + m.front_to_joint_m) * ground.slope_ahead


@_compiled
def _ride(k: Constants, m: Record, ground: Contact, old: Record, now: Record) -> None:
    """The joint leaves roll to the wheels of one axle."""
    _aim(m, ground, now)
    wheelbase = m.rear_to_joint_m + m.front_to_joint_m
    ahead = m.front_share * wheelbase
    along, across = 2 * (ahead**2 + (wheelbase - ahead) ** 2), 2 * m.half_track_m**2
    sunk_front, sunk_rear = _sunk(k, m, ground, old.centre_mps2)
    nose_up = (sunk_rear - sunk_front) / wheelbase
    ride = (old.ride_m, old.ride_mps, old.ride_aim_m)
    pitch = (old.pitch_rad, old.pitch_radps, old.pitch_aim_rad)
    roll = (old.roll_rad, old.roll_radps, old.roll_aim_rad)
    sunk = sunk_rear - ahead * nose_up
    now.ride_m, now.ride_mps = _spring(k.dt_s, m, 4 / m.mass_kg, ride, now.ride_aim_m, -sunk)
    now.pitch_rad, now.pitch_radps = _spring(
        k.dt_s, m, along / m.pitch_inertia_kgm2, pitch, now.pitch_aim_rad, -nose_up
    )
    now.roll_rad, now.roll_radps = _spring(k.dt_s, m, across / m.roll_inertia_kgm2, roll, now.roll_aim_rad, 0.0)


@_compiled
def _sunk(k: Constants, m: Record, ground: Contact, accel: float) -> tuple[float, float]:
    """Static deflection of front and rear tyres beyond that of the empty machine."""
    slope = math.sqrt(1 + ground.slope_ahead**2)
    level = m.mass_kg * k.gravity / slope
    shifted = (level * ground.slope_ahead + m.mass_kg * accel) * m.centre_height_m
    front = m.front_share * level - shifted / (m.rear_to_joint_m + m.front_to_joint_m)
    axle = 2 * m.tyre_stiffness_npm
    return front / axle - m.level_front_m, (level - front) / axle - m.level_rear_m


@_compiled
def _spring(
    dt: float, m: Record, ease: float, old: tuple[float, float, float], aim: float, pushed: float
) -> tuple[float, float]:
    """One step of a sprung value towards a moving equilibrium; returns value and rate.

    old: value, rate, equilibrium. ease: squared lever arms of the tyres over inertia. pushed: static offset under the
    weight.
    """
    value, rate, old_aim = old
    force = m.tyre_stiffness_npm * (aim + pushed - value) + m.tyre_damping_nspm * ((aim - old_aim) / dt - rate)
    rate += dt * ease * force
    return value + dt * rate, rate


@_compiled
def _inertial(k: Constants, m: Record, moved: Moved, rates: Rates, before: Record, now: Record) -> None:
    """Angular rate and specific force at `base_link`, as gyroscope and accelerometer measure them."""
    pitch, pitching, roll, rolling = now.pitch_rad, now.pitch_radps, now.roll_rad, now.roll_radps
    cp, sp, cr, sr = math.cos(pitch), math.sin(pitch), math.cos(roll), math.sin(roll)
    about_z = moved.turning * cr * cp - pitching * sr
    now.rates_radps[0] = rolling - moved.turning * sp
    now.rates_radps[1] = pitching * cr + moved.turning * sr * cp
    now.rates_radps[2] = about_z
    for axis in range(3):
        now.rates_dot_radps2[axis] = (now.rates_radps[axis] - before.rates_radps[axis]) / k.dt_s
    # The rear axle rises with the centre, and by the pitch.
    raised = rates.lifting + m.front_share * (m.rear_to_joint_m + m.front_to_joint_m) * rates.pitching_dot
    now.force_mps2[0] = now.accel_mps2 - k.gravity * sp
    now.force_mps2[1] = moved.speed * about_z + k.gravity * cp * sr
    now.force_mps2[2] = raised + k.gravity * cp * cr
