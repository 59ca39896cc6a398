"""Drivers: pure pursuit in both directions, a speed controller, stops, giving way."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from protocol.arrays import Bools, Floats, Ints
from sim.operators.course import BEYOND_M, Course, Crew, Start
from sim.operators.habits import Habits
from sim.state import FleetState

DRIVER_STEPS = 5  # world steps per action: 20 Hz
LOOK_AHEAD_M, LOOK_AHEAD_S = 2.5, 0.6
REVERSE_SHARE = 0.5  # speed in reverse over speed forwards
GAIN_PER_S, INTEGRAL_PER_S2 = 2.9, 1.15  # acceleration per m/s of speed error, and per m of its integral
START_MPS2, STOP_MPS2 = 0.8, 0.5
STOP_M, STANDING_MPS = 0.3, 0.03  # distance at which a leg's end is reached; speed below which a machine stands
LOOK_OUT_STEPS = 20  # world steps per look-out: 5 Hz
OVERHANG_M = 2.2  # frame or bucket beyond an axle
CLEARANCE_M = 3.6  # from a leg to the middle of another machine: two half widths plus margin
DISTANCE_M = 3.0  # to the machine ahead
PROSPECT_S = (0.0, 1.5, 3.0)  # look-ahead times for other machines, at constant velocity
AHEAD_M = np.arange(2.0, BEYOND_M + 1e-9, 2.0)


@dataclass(frozen=True)
class Drivers:
    """State of n drivers: leg, distance along it [m], target speed [m/s], controller integral [N].

    waited_s: standing time at the leg's end. clear_m: free distance ahead. driven_m: in total. stops: own stops made;
    stop_m: driven distance of the next; stood_s: standing time there.
    """

    leg: Ints
    distance_m: Floats
    aim_mps: Floats
    integral_n: Floats
    waited_s: Floats
    payload_kg: Floats
    clear_m: Floats
    driven_m: Floats
    stops: Ints
    stop_m: Floats
    stood_s: Floats


@dataclass(frozen=True)
class DriverCommands:
    """Commands of n drivers: articulation, drive force, brake force limit, payload."""

    steer_rad: Floats
    drive_n: Floats
    brake_n: Floats
    payload_kg: Floats


def at_start(starts: Sequence[Start], habits: Habits) -> Drivers:
    """Drivers before the first step."""
    zero, none = np.zeros(len(starts)), np.zeros(len(starts), np.int64)
    return Drivers(
        leg=np.array([start.leg for start in starts]),
        distance_m=np.array([start.distance_m for start in starts]),
        aim_mps=zero,
        integral_n=zero,
        waited_s=zero,
        payload_kg=np.array([start.payload_kg for start in starts]),
        clear_m=np.full(len(starts), np.inf),
        driven_m=zero,
        stops=none,
        stop_m=habits.stop(none)[0],
        stood_s=zero,
    )


def no_commands(machines: int) -> DriverCommands:
    """Commands before the first step."""
    zero = np.zeros(machines)
    return DriverCommands(zero, zero, zero, zero)


def drive(
    course: Course, crew: Crew, habits: Habits, old: Drivers, state: FleetState, dt: float
) -> tuple[Drivers, DriverCommands]:
    """Drive one step; returns new drivers and commands."""
    # Progress on the leg; at its end stop, wait, load, take the next.
    position = crew.joint_m(state)
    arrived = ~course.closed[old.leg] & (course.length_m[old.leg] - old.distance_m < STOP_M)
    standing = np.abs(state.speed_mps) < STANDING_MPS
    waited = np.where(arrived & standing, old.waited_s + dt, 0.0)
    payload = _payload(course, old, waited, dt)
    done = waited > course.wait_s[old.leg]
    leg = np.where(done, course.following[old.leg], old.leg)
    distance = _nearest_distance(course, leg, np.where(done, 0.0, old.distance_m), position)
    arrived &= ~done
    travel = course.travel[leg]

    # The driver's own stops.
    driven = old.driven_m + np.abs(state.speed_mps) * dt
    at_stop = old.stop_m - driven < STOP_M
    stood = np.where(at_stop & standing, old.stood_s + dt, 0.0)
    rested = stood > habits.stop(old.stops)[1]
    stops = old.stops + rested
    stop = np.where(rested, driven + habits.stop(stops)[0], old.stop_m)
    at_stop &= ~rested

    # Aim at a point ahead, offset by the driver's wander.
    speed = travel * state.speed_mps
    target_distance = distance + LOOK_AHEAD_M + LOOK_AHEAD_S * np.abs(speed)
    point, direction = course.at(leg, target_distance)
    lateral = travel * habits.lateral_m(driven + target_distance - distance)
    target = point + lateral[:, None] * np.stack([-direction[:, 1], direction[:, 0]], axis=-1) - position
    wheelbase = crew.rear_to_joint_m + crew.front_to_joint_m
    heading = state.yaw_rad + state.articulation_rad * crew.rear_to_joint_m / wheelbase
    steer = travel * pursue(crew, target, np.where(travel < 0, heading + np.pi, heading))
    steer = np.where(at_stop, state.articulation_rad, steer)  # steering at standstill would fold the machine

    # Approach the leg's speed limit gently from below, at once from above.
    limit = np.where(travel < 0, REVERSE_SHARE, 1.0) * course.limit(leg, distance + LOOK_AHEAD_S * speed)
    to_go = np.where(course.closed[leg], np.inf, course.length_m[leg] - distance)
    to_go = np.minimum(to_go, stop - driven)
    limit = np.minimum(limit, np.sqrt(2 * STOP_MPS2 * np.maximum(to_go - 0.5 * STOP_M, 0.05)))
    limit = np.where(arrived | at_stop, 0.0, np.minimum(limit, np.sqrt(2 * START_MPS2 * old.clear_m)))
    aim = np.minimum(limit, np.maximum(old.aim_mps, 0.0) + START_MPS2 * dt)
    halt = (aim < STANDING_MPS) & (np.abs(speed) < 5 * STANDING_MPS)
    # At an own stop the integral stays: the start needs its torque against the slope.
    afresh = (halt & ~at_stop) | done
    force, integral = hold_speed(crew, aim, speed, np.where(afresh, 0.0, old.integral_n), dt)
    commands = DriverCommands(
        steer_rad=steer,
        drive_n=np.where(halt, 0.0, travel * force),
        brake_n=np.where(halt, crew.max_brake_n, 0.0),
        payload_kg=payload,
    )
    waited = np.where(done, 0.0, waited)
    stood = np.where(rested, 0.0, stood)
    return Drivers(leg, distance, aim, integral, waited, payload, old.clear_m, driven, stops, stop, stood), commands


def look_out(course: Course, crew: Crew, old: Drivers, state: FleetState) -> Drivers:
    """Update the free distance ahead."""
    return replace(old, clear_m=_clear_distance(course, crew, old.leg, old.distance_m, state))


def pursue(crew: Crew, target_m: Floats, heading_rad: Floats) -> Floats:
    """Articulation (n,) whose circle leads the joint through the target (n, 2), relative to it in `map`.

    With curvature k and distance l from axle to joint, each frame is turned from the joint's track by asin(k l).
    """
    c, s = np.cos(heading_rad), np.sin(heading_rad)
    left = target_m[:, 1] * c - target_m[:, 0] * s
    curvature = 2 * left / np.maximum((target_m**2).sum(axis=-1), 1.0)
    articulation = bend(crew.rear_to_joint_m, crew.front_to_joint_m, curvature)
    return np.minimum(np.maximum(articulation, -crew.max_articulation_rad), crew.max_articulation_rad)


def bend(rear_m: Floats, front_m: Floats, curvature_pm: Floats) -> Floats:
    """Articulation [rad] at which the joint drives a circle of this curvature [1/m]."""
    bent: Floats = np.arcsin(np.clip(rear_m * curvature_pm, -1, 1)) + np.arcsin(np.clip(front_m * curvature_pm, -1, 1))
    return bent


def hold_speed(crew: Crew, aim_mps: Floats, speed_mps: Floats, integral_n: Floats, dt: float) -> tuple[Floats, Floats]:
    """PI controller within force and power limits, anti wind-up by clamping the integral."""
    error = aim_mps - speed_mps
    strongest = np.minimum(crew.max_drive_n, crew.max_power_w / np.maximum(np.abs(speed_mps), 0.6))
    grown = integral_n + INTEGRAL_PER_S2 * crew.mass_kg * dt * error
    integral = np.minimum(np.maximum(grown, -crew.max_brake_n), strongest)
    force = GAIN_PER_S * crew.mass_kg * error + integral
    return np.minimum(np.maximum(force, -crew.max_brake_n), strongest), integral


def _nearest_distance(course: Course, leg: Ints, distance_m: Floats, position_m: Floats) -> Floats:
    nearest, direction = course.at(leg, distance_m)
    distance = distance_m + ((position_m - nearest) * direction).sum(axis=-1)
    length = course.length_m[leg]
    lap: Floats = distance - np.where(course.closed[leg] & (distance >= length), length, 0.0)
    return lap


def _payload(course: Course, old: Drivers, waited_s: Floats, dt: float) -> Floats:
    target_kg, wait_s = course.payload_kg[old.leg], course.wait_s[old.leg]
    changes: Bools = (waited_s > 0) & ~np.isnan(target_kg)
    share = dt / np.maximum(wait_s - waited_s + dt, dt)
    return np.where(changes, old.payload_kg + np.minimum(share, 1.0) * (target_kg - old.payload_kg), old.payload_kg)


def _clear_distance(course: Course, crew: Crew, leg: Ints, distance_m: Floats, state: FleetState) -> Floats:
    """Free distance (n,) [m] ahead; infinite if no machine is near the leg.

    Of two machines that block each other, the one nearer to the conflict goes first.
    """
    n, travel, joint_m = len(distance_m), course.travel[leg], crew.joint_m(state)
    heading = np.stack([np.cos(state.yaw_rad), np.sin(state.yaw_rad)], axis=-1)
    front, rear = crew.front_to_joint_m + OVERHANG_M, crew.rear_to_joint_m + OVERHANG_M
    along = [np.zeros(n), front, -rear]
    spots = [offset + state.speed_mps * s for s in PROSPECT_S for offset in along]
    others = np.stack([joint_m + heading * spot[:, None] for spot in spots], axis=1)  # (n, spots, 2)

    path = np.stack([course.at(leg, distance_m + ahead)[0] for ahead in AHEAD_M], axis=1)  # (n, ahead, 2)
    nose = np.where(travel > 0, front, rear)
    gap = np.hypot(*(path[:, None, :, None] - others[None, :, None]).transpose(4, 0, 1, 2, 3)).min(axis=-1)
    blocked = gap < CLEARANCE_M  # (machine, other, ahead)
    blocked[np.arange(n), np.arange(n)] = False
    first = np.where(blocked.any(axis=-1), AHEAD_M[blocked.argmax(axis=-1)], np.inf)
    nearer = (first < first.T) | ((first == first.T) & (np.arange(n)[:, None] < np.arange(n)))
    first[np.isfinite(first.T) & nearer] = np.inf
    clear: Floats = np.maximum(first.min(axis=1) - nose - DISTANCE_M, 0.0)
    return clear
