"""Drivers: pure pursuit along closed routes and a speed controller with limited force and power."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from protocol.arrays import Floats, Ints
from sim.routes import Route, speed_limits
from sim.vehicle import AXLE_TO_JOINT_M
from sim.world import FleetState

MAX_ARTICULATION_RAD = 0.6
LOOK_AHEAD_M, LOOK_AHEAD_S = 2.5, 0.6
MAX_DRIVE_N, MAX_BRAKE_N, MAX_POWER_W = 130e3, 80e3, 140e3
GAIN_N, INTEGRAL_N = 50e3, 20e3  # drive force per m/s of speed error, and per m
START_MPS2 = 0.8


@dataclass(frozen=True)
class Course:
    """Routes of n machines side by side. points: all of them, (k, 2), each lap followed by its first point again."""

    points: Floats
    limits_mps: Floats
    first: Ints
    count: Ints
    spacing_m: Floats

    def at(self, way_m: Floats) -> tuple[Floats, Floats]:
        """Point (n, 2) after way_m (n,) along each machine's route, and the direction of the route there (n, 2)."""
        index, share = self._locate(way_m)
        here = self.points[index]
        step = self.points[index + 1] - here
        return here + share[:, None] * step, step / self.spacing_m[:, None]

    def limit(self, way_m: Floats) -> Floats:
        """Speed to aim at [m/s]."""
        limit: Floats = self.limits_mps[self._locate(way_m)[0]]
        return limit

    def _locate(self, way_m: Floats) -> tuple[Ints, Floats]:
        steps = way_m / self.spacing_m
        whole = np.floor(steps)
        return self.first + whole.astype(np.int64) % self.count, steps - whole


@dataclass(frozen=True)
class Drivers:
    """What n drivers keep in mind: way along the route [m], integral of the speed controller [N], time [s]."""

    way_m: Floats
    integral_n: Floats
    time_s: float = 0.0


def lay_course(routes: list[Route], drive_mps: float) -> Course:
    """Prepare one route per machine."""
    laps = [np.vstack([r.points, r.points[:1]]) for r in routes]
    limits = [np.append(v, v[0]) for v in (speed_limits(r, drive_mps) for r in routes)]
    lengths = np.array([len(lap) for lap in laps])
    return Course(
        points=np.vstack(laps),
        limits_mps=np.concatenate(limits),
        first=np.cumsum(lengths) - lengths,
        count=lengths - 1,
        spacing_m=np.array([r.spacing_m for r in routes]),
    )


def drive(course: Course, drivers: Drivers, state: FleetState, dt: float) -> tuple[Drivers, Floats, Floats]:
    """Return the drivers' next memory, the articulation [rad] and the drive force [N] that they ask for."""
    position = joint(state)
    nearest, direction = course.at(drivers.way_m)
    way = drivers.way_m + ((position - nearest) * direction).sum(axis=-1)
    target = course.at(way + LOOK_AHEAD_M + LOOK_AHEAD_S * state.speed_mps)[0] - position
    steer = pursue(target, state.yaw_rad + 0.5 * state.articulation_rad)

    aim = np.minimum(course.limit(way + LOOK_AHEAD_S * state.speed_mps), START_MPS2 * drivers.time_s)
    force, integral = hold_speed(aim, state.speed_mps, drivers.integral_n, dt)
    return Drivers(way, integral, drivers.time_s + dt), steer, force


def joint(state: FleetState) -> Floats:
    """Position (n, 2) of the articulation joint; it goes where the frames' mean heading points, however they steer."""
    x = state.x_m + AXLE_TO_JOINT_M * np.cos(state.yaw_rad)
    return np.stack([x, state.y_m + AXLE_TO_JOINT_M * np.sin(state.yaw_rad)], axis=-1)


def pursue(target_m: Floats, heading_rad: Floats) -> Floats:
    """Articulation (n,) whose circle leads the joint through the target (n, 2), given relative to it in `map`."""
    c, s = np.cos(heading_rad), np.sin(heading_rad)
    left = target_m[:, 1] * c - target_m[:, 0] * s
    curvature = 2 * left / np.maximum((target_m**2).sum(axis=-1), 1.0)
    articulation: Floats = 2 * np.arctan(AXLE_TO_JOINT_M * curvature)
    return np.minimum(np.maximum(articulation, -MAX_ARTICULATION_RAD), MAX_ARTICULATION_RAD)


def hold_speed(aim_mps: Floats, speed_mps: Floats, integral_n: Floats, dt: float) -> tuple[Floats, Floats]:
    """PI controller within the limits of force and power; its integral never leaves them (no wind-up)."""
    error = aim_mps - speed_mps
    strongest = np.minimum(MAX_DRIVE_N, MAX_POWER_W / np.maximum(speed_mps, 0.6))
    integral = np.minimum(np.maximum(integral_n + INTEGRAL_N * dt * error, -MAX_BRAKE_N), strongest)
    return np.minimum(np.maximum(GAIN_N * error + integral, -MAX_BRAKE_N), strongest), integral
