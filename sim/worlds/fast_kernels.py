"""The fast world's inner loops, compiled by numba: the ground at places, and one step of machines.

All of them are in this file, and constants of other files are passed in: numba's cache notices changes here alone.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np

from protocol.arrays import Floats, Ints

_compiled = numba.njit(cache=True, inline="always", error_model="numpy")

# Rows of the state (ROWS, n), as `world.FleetState` explains them; vectors begin at theirs. GRIP: the most drive force.
# CRAB: how far a machine moves off its heading to the left, because tyres push aside only while they slip aside. RIDE:
# how high the body's centre is, and how fast it rises. *_AIM: where ride, pitch and roll would settle.
X, Y, Z, YAW, PITCH, ROLL, SPEED, ACCEL, PITCHING, ROLLING = range(10)
RATES, RATES_DOT, FORCE = 10, 13, 16
BEND, STEERING, STEERING_DOT, DRIVE, TORQUE, LOAD = range(19, 25)
SPIN, TURNED = 25, 27
C_RR, GRADE_E, GRADE_N, GRIP, CRAB, RIDE, RIDING, RIDE_AIM, PITCH_AIM, ROLL_AIM = range(29, 39)
ROWS = 39


class Grid(NamedTuple):
    """Arrays of `terrain.Terrain`."""

    heights_m: Floats
    cell_m: float
    zones: Ints
    zone_cell_m: float


class Constants(NamedTuple):
    """Numbers of other modules."""

    dt_s: float
    gravity: float
    standstill_mps: float
    traction_use: float


class Machine(NamedTuple):
    """One machine, as `vehicle.Chassis` and `vehicle.Weight` explain it."""

    rear_to_joint_m: float
    front_to_joint_m: float
    half_track_m: float
    rolls_with_front: float
    mass_kg: float
    front_share: float
    centre_height_m: float
    pitch_inertia_kgm2: float
    roll_inertia_kgm2: float
    tyre_stiffness_npm: float
    tyre_damping_nspm: float
    wheel_radius_m: float
    wheel_inertia_kgm2: float


class Moved(NamedTuple):
    """Where a machine is after a step, and how fast it moves and turns."""

    x: float
    y: float
    yaw: float
    bend: float
    speed: float
    turning: float


class Contact(NamedTuple):
    """The ground under a machine.

    z: below the rear axle. slope: of the plane on which the rear frame rests, along its axes. climb: mean slope of the
    ground right under an axle's wheels, the way they roll. grade: of the plane through all wheels, in `map`. zones:
    front left, front right, rear left, rear right.
    """

    z: float
    slope_ahead: float
    slope_left: float
    climb_front: float
    climb_rear: float
    grade_e: float
    grade_n: float
    zones: tuple[int, int, int, int]


class Moves(NamedTuple):
    """How a machine moves.

    turning: of the rear frame. accel, force_left: acceleration ahead and specific force to the left, of the last step.
    lifting: acceleration of its centre off the ground. riding: how fast the centre rises. pitch, pitching: nose down.
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
    """Forces along the way, and what follows from them.

    grip: the most drive force that spins up no wheel. tyres: what drive and brakes make them push with. crab: angle by
    which all wheels slip aside. wheel_ratio: wheel speed over ground speed.
    """

    load: float
    c_rr: float
    grip: float
    tyres: float
    accel: float
    crab: float
    wheel_ratio: float


@_compiled
def surface(heights: Floats, cell: float, x: float, y: float) -> tuple[float, float, float]:
    """Height, bilinear between the nodes, and its slopes to the east and north; beyond the edges, the edge goes on."""
    rows, columns = heights.shape
    u, v = x / cell, y / cell
    i, j = min(max(int(u), 0), columns - 2), min(max(int(v), 0), rows - 2)
    a, b = min(max(u - i, 0.0), 1.0), min(max(v - j, 0.0), 1.0)
    h00, h10, h01, h11 = heights[j, i], heights[j, i + 1], heights[j + 1, i], heights[j + 1, i + 1]
    south, north = h00 + a * (h10 - h00), h01 + a * (h11 - h01)
    east = (h10 - h00) * (1 - b) + (h11 - h01) * b
    return south + b * (north - south), east / cell, (north - south) / cell


@_compiled
def zone(zones: Ints, cell: float, x: float, y: float) -> int:
    """Zone of the cell; beyond the edges, the edge goes on."""
    rows, columns = zones.shape
    found: int = zones[min(max(int(y / cell), 0), rows - 1), min(max(int(x / cell), 0), columns - 1)]
    return found


@_compiled
def surfaces(grid: Grid, x: Floats, y: Floats) -> Floats:
    """`surface` of places (k,), as (3, k)."""
    found, heights, cell = np.empty((3, x.size)), grid.heights_m, grid.cell_m
    for i in range(x.size):
        found[0, i], found[1, i], found[2, i] = surface(heights, cell, x[i], y[i])
    return found


@_compiled
def zones(grid: Grid, x: Floats, y: Floats) -> Ints:
    """`zone` of places (k,)."""
    found, cells, cell = np.empty(x.size, np.int64), grid.zones, grid.zone_cell_m
    for i in range(x.size):
        found[i] = zone(cells, cell, x[i], y[i])
    return found


@_compiled
def advance(
    k: Constants, soils: Floats, rows: Floats, grid: Grid, old: Floats, steering: Floats, drive: Floats, brake: Floats
) -> Floats:
    """Advance machines by one step.

    soils: resistance, traction and slip stiffness of each zone, (3, zones). rows: those of `Machine`, (9, n).
    old: (ROWS, n). The rest (n,): rate of articulation, drive force, and most force of the brakes.
    """
    new = np.empty_like(old)
    for i in range(old.shape[1]):
        # Move, then look up the ground at the new place, and the forces there.
        m = _machine(rows, i)
        moved = _move(k.dt_s, m, old, steering[i], i)
        ground = _touch(m, grid.heights_m, grid.cell_m, grid.zones, grid.zone_cell_m, moved)
        _ride(k.dt_s, m, ground, old, new, i)
        moves = Moves(
            speed=moved.speed,
            turning=moved.turning,
            accel=old[ACCEL, i],
            force_left=old[FORCE + 1, i],
            lifting=(new[RIDING, i] - old[RIDING, i]) / k.dt_s + old[ACCEL, i] * math.sin(new[PITCH_AIM, i]),
            riding=new[RIDING, i],
            pitch=new[PITCH, i],
            pitching=new[PITCHING, i],
            pitching_dot=(new[PITCHING, i] - old[PITCHING, i]) / k.dt_s,
        )
        forces = _forces(k, soils, m, ground, moves, drive[i], brake[i])

        new[X, i], new[Y, i], new[YAW, i] = moved.x, moved.y, moved.yaw
        new[Z, i] = ground.z + new[RIDE, i] - new[RIDE_AIM, i]
        new[BEND, i], new[STEERING, i] = moved.bend, steering[i]
        new[STEERING_DOT, i] = (steering[i] - old[STEERING, i]) / k.dt_s
        new[SPEED, i], new[ACCEL, i] = moved.speed, forces.accel
        new[DRIVE, i], new[TORQUE, i], new[GRIP, i] = drive[i], forces.tyres * m.wheel_radius_m, forces.grip
        new[LOAD, i], new[C_RR, i], new[CRAB, i] = forces.load, forces.c_rr, forces.crab
        new[GRADE_E, i], new[GRADE_N, i] = ground.grade_e, ground.grade_n
        _turn_wheels(k.dt_s, forces.wheel_ratio / m.wheel_radius_m, m.half_track_m, moved, old, new, i)
        _feel(k, m, moved, moves, old, new, i)
    return new


@_compiled
def _machine(rows: Floats, i: int) -> Machine:
    return Machine(
        rear_to_joint_m=rows[0, i],
        front_to_joint_m=rows[1, i],
        half_track_m=rows[2, i],
        rolls_with_front=rows[3, i],
        mass_kg=rows[4, i],
        front_share=rows[5, i],
        centre_height_m=rows[6, i],
        pitch_inertia_kgm2=rows[7, i],
        roll_inertia_kgm2=rows[8, i],
        tyre_stiffness_npm=rows[9, i],
        tyre_damping_nspm=rows[10, i],
        wheel_radius_m=rows[11, i],
        wheel_inertia_kgm2=rows[12, i],
    )


@_compiled
def _move(dt: float, m: Machine, old: Floats, steering: float, i: int) -> Moved:
    """Move both frames; neither axle slips sideways.

    With arms L_r and L_f to the joint: (L_f + L_r cos g) dyaw/dt = v sin g - L_f dg/dt.
    """
    rear, front = m.rear_to_joint_m, m.front_to_joint_m
    bend, speed = old[BEND, i] + dt * steering, old[SPEED, i] + dt * old[ACCEL, i]
    turning = (speed * math.sin(bend) - front * steering) / (front + rear * math.cos(bend))
    level, heading = dt * speed * math.cos(old[PITCH, i]), old[YAW, i] + 0.5 * dt * turning + old[CRAB, i]
    x, y = old[X, i] + level * math.cos(heading), old[Y, i] + level * math.sin(heading)
    return Moved(x, y, old[YAW, i] + dt * turning, bend, speed, turning)


@_compiled
def _touch(m: Machine, heights: Floats, cell: float, zones: Ints, zone_cell: float, at: Moved) -> Contact:
    """Look up the ground under the wheels."""
    # From the rear axle's centre, along the rear frame's axes: the front axle's centre, and the left half of the axle.
    cf, sf = math.cos(at.bend), math.sin(at.bend)
    ahead_x = m.rear_to_joint_m + m.front_to_joint_m * cf
    ahead_y = m.front_to_joint_m * sf
    half = m.half_track_m
    left_x, left_y = -half * sf, half * cf

    c, s = math.cos(at.yaw), math.sin(at.yaw)
    fl, east_fl, north_fl, zone_fl = _under(
        heights, cell, zones, zone_cell, at, c, s, ahead_x + left_x, ahead_y + left_y
    )
    fr, east_fr, north_fr, zone_fr = _under(
        heights, cell, zones, zone_cell, at, c, s, ahead_x - left_x, ahead_y - left_y
    )
    rl, east_rl, north_rl, zone_rl = _under(heights, cell, zones, zone_cell, at, c, s, 0.0, half)
    rr, east_rr, north_rr, zone_rr = _under(heights, cell, zones, zone_cell, at, c, s, 0.0, -half)
    z = 0.5 * (rl + rr)
    rise, front, rear = 0.5 * (fl + fr) - z, 0.5 * (fl - fr), 0.5 * (rl - rr)

    if m.rolls_with_front > 0:
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
def _under(
    heights: Floats,
    cell: float,
    zones: Ints,
    zone_cell: float,
    at: Moved,
    c: float,
    s: float,
    ahead: float,
    left: float,
) -> tuple[float, float, float, int]:
    """Height, its slopes to the east and north, and the zone at a place relative to the rear axle's centre."""
    x, y = at.x + c * ahead - s * left, at.y + s * ahead + c * left
    height, east, north = surface(heights, cell, x, y)
    return height, east, north, zone(zones, zone_cell, x, y)


@_compiled
def _plane(ax: float, ay: float, az: float, bx: float, by: float, bz: float) -> tuple[float, float]:
    """Slopes along x and y of the plane that two vectors span."""
    area = ax * by - ay * bx
    return (az * by - bz * ay) / area, (bz * ax - az * bx) / area


@_compiled
def _forces(
    k: Constants,
    soils: Floats,
    m: Machine,
    ground: Contact,
    moves: Moves,
    drive: float,
    brake: float,
) -> Forces:
    """Forces along the way."""
    # The ground's normal force, shifted to the rear uphill, under power and as the nose drops; what soil makes of it.
    speed, weight = moves.speed, m.mass_kg * k.gravity
    level = weight / math.sqrt(1 + ground.grade_e**2 + ground.grade_n**2)
    load = max(level + m.mass_kg * moves.lifting, 0.1 * level)
    pitched = weight * ground.slope_ahead / math.sqrt(1 + ground.slope_ahead**2)
    tilting = (pitched + m.mass_kg * moves.accel) * m.centre_height_m + m.pitch_inertia_kgm2 * moves.pitching_dot
    front = min(max(m.front_share * load - tilting / (m.rear_to_joint_m + m.front_to_joint_m), 0.0), load)
    nose_up = -moves.pitch
    climb = weight * math.sin(nose_up)
    climb += front * math.sin(math.atan(ground.climb_front) - nose_up)
    climb += (load - front) * math.sin(math.atan(ground.climb_rear) - nose_up)
    resistance = _borne(soils, 0, ground.zones, front, load)
    traction = _borne(soils, 1, ground.zones, front, load)
    stiffness = _borne(soils, 2, ground.zones, front, load)

    # Brakes take what they can, down to standstill at the end of the next step, and hold it there.
    # Of a body that pitches, `base_link` moves otherwise than its centre, v' + q' h = F / m - q w.
    centre_mps = speed + moves.pitching * m.centre_height_m
    upward_mps = moves.riding * math.cos(nose_up) - centre_mps * math.sin(nose_up)
    tipping = m.mass_kg * (moves.pitching_dot * m.centre_height_m + moves.pitching * upward_mps)
    inertia = m.mass_kg + 4 * m.wheel_inertia_kgm2 / m.wheel_radius_m**2
    # Wheels that push aside slip aside; in a curve, v' = F / m + w v_left then slows the machine down.
    moving = math.tanh(speed / k.standstill_mps)
    crab = -m.mass_kg * moves.force_left / stiffness * moving
    drag = -m.mass_kg * moves.turning * speed * crab
    against = resistance * moving + drag + climb + tipping
    to_stop = inertia * speed / k.dt_s + drive - against
    most = k.traction_use * traction
    tyres = min(max(drive - min(max(to_stop, -brake), brake), -most), most)

    # Slip refers to the faster of wheel and ground: pushing, v = wheel (1 - slip), holding back, wheel = v (1 - slip).
    slower = 1 - math.atanh(abs(tyres) / traction) * traction / stiffness
    ratio = 1 / slower if tyres * speed > 0 else slower
    fl, fr, rl, rr = ground.zones
    least = min(min(soils[1, fl], soils[1, fr]), min(soils[1, rl], soils[1, rr]))
    return Forces(
        load, resistance / load, k.traction_use * least * load, tyres, (tyres - against) / inertia, crab, ratio
    )


@_compiled
def _borne(soils: Floats, value: int, zones: tuple[int, int, int, int], front: float, load: float) -> float:
    """Sum of a soil's value times the wheels' loads; the wheels of an axle bear the same."""
    fl, fr, rl, rr = zones
    ahead, behind = soils[value, fl] + soils[value, fr], soils[value, rl] + soils[value, rr]
    total: float = 0.5 * (front * ahead + (load - front) * behind)
    return total


@_compiled
def _turn_wheels(
    dt: float, radps_per_mps: float, half_track: float, at: Moved, old: Floats, new: Floats, i: int
) -> None:
    """Turn the rear wheels, each as fast as its side moves."""
    aside = at.turning * half_track
    new[SPIN, i], new[SPIN + 1, i] = (at.speed - aside) * radps_per_mps, (at.speed + aside) * radps_per_mps
    for side in range(2):
        new[TURNED + side, i] = old[TURNED + side, i] + dt * new[SPIN + side, i]


@_compiled
def settle(rows: Floats, grid: Grid, state: Floats) -> None:
    """Put bodies (ROWS, n) down where they will rest."""
    for i in range(state.shape[1]):
        m = _machine(rows, i)
        at = Moved(state[X, i], state[Y, i], state[YAW, i], state[BEND, i], 0.0, 0.0)
        _aim(m, _touch(m, grid.heights_m, grid.cell_m, grid.zones, grid.zone_cell_m, at), state, i)
        state[RIDE, i], state[PITCH, i], state[ROLL, i] = state[RIDE_AIM, i], state[PITCH_AIM, i], state[ROLL_AIM, i]


@_compiled
def _aim(m: Machine, ground: Contact, new: Floats, i: int) -> None:
    """Where the body would settle on the plane that carries it."""
    slope = math.sqrt(1 + ground.slope_ahead**2)
    new[PITCH_AIM, i] = -math.atan(ground.slope_ahead)
    new[ROLL_AIM, i] = math.atan(ground.slope_left / slope)
    new[RIDE_AIM, i] = ground.z + m.front_share * (m.rear_to_joint_m + m.front_to_joint_m) * ground.slope_ahead


@_compiled
def _ride(dt: float, m: Machine, ground: Contact, old: Floats, new: Floats, i: int) -> None:
    """Let the body bounce, pitch and roll on its tyres; the joint leaves roll to the wheels of one axle."""
    _aim(m, ground, new, i)
    wheelbase = m.rear_to_joint_m + m.front_to_joint_m
    ahead = m.front_share * wheelbase
    along, aside = 2 * (ahead**2 + (wheelbase - ahead) ** 2), 2 * m.half_track_m**2
    _spring(dt, m, 4 / m.mass_kg, (RIDE, RIDING, RIDE_AIM), old, new, i)
    _spring(dt, m, along / m.pitch_inertia_kgm2, (PITCH, PITCHING, PITCH_AIM), old, new, i)
    _spring(dt, m, aside / m.roll_inertia_kgm2, (ROLL, ROLLING, ROLL_AIM), old, new, i)


@_compiled
def _spring(dt: float, m: Machine, ease: float, where: tuple[int, int, int], old: Floats, new: Floats, i: int) -> None:
    """One step of a value on tyres, towards an aim that moves; ease: lever arms of the tyres squared, over inertia."""
    value, rate, aim = where
    stiffness, damping = m.tyre_stiffness_npm, m.tyre_damping_nspm
    aiming = (new[aim, i] - old[aim, i]) / dt
    push = stiffness * (new[aim, i] - old[value, i]) + damping * (aiming - old[rate, i])
    new[rate, i] = old[rate, i] + dt * ease * push
    new[value, i] = old[value, i] + dt * new[rate, i]


@_compiled
def _feel(k: Constants, m: Machine, moved: Moved, moves: Moves, old: Floats, new: Floats, i: int) -> None:
    """What gyroscope and accelerometer at `base_link` feel."""
    pitch, pitching, roll, rolling = new[PITCH, i], new[PITCHING, i], new[ROLL, i], new[ROLLING, i]
    cp, sp, cr, sr = math.cos(pitch), math.sin(pitch), math.cos(roll), math.sin(roll)
    about_x = rolling - moved.turning * sp
    about_y = pitching * cr + moved.turning * sr * cp
    about_z = moved.turning * cr * cp - pitching * sr
    new[RATES, i], new[RATES + 1, i], new[RATES + 2, i] = about_x, about_y, about_z
    for axis in range(3):
        new[RATES_DOT + axis, i] = (new[RATES + axis, i] - old[RATES + axis, i]) / k.dt_s
    # The rear axle is raised as the centre is, and by the pitch.
    raised = moves.lifting + m.front_share * (m.rear_to_joint_m + m.front_to_joint_m) * moves.pitching_dot
    new[FORCE, i] = new[ACCEL, i] - k.gravity * sp
    new[FORCE + 1, i] = moved.speed * about_z + k.gravity * cp * sr
    new[FORCE + 2, i] = raised + k.gravity * cp * cr
