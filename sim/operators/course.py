"""All machines' routes in flat arrays, for vectorised drivers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from protocol.arrays import Bools, Floats, Ints
from sim.machines.model import MachineModel
from sim.operators.routes import SPACING_M, Leg, Route, speed_limits
from sim.state import FleetState

BEYOND_M = 24.0  # length by which every leg is extended, for look-ahead
APART_M = 12.0  # minimum distance between joints at the start


@dataclass(frozen=True)
class Course:
    """Concatenated legs of n machines. points, limits_mps: per point, each leg from `first` to `last`.

    The rest: per leg. following: next leg. payload_kg: NaN: unchanged.
    """

    points: Floats
    limits_mps: Floats
    first: Ints
    last: Ints
    spacing_m: Floats
    length_m: Floats
    closed: Bools
    travel: Floats  # 1 forwards, -1 in reverse
    wait_s: Floats
    payload_kg: Floats
    following: Ints

    def at(self, leg: Ints, distance_m: Floats) -> tuple[Floats, Floats]:
        """Point and direction (n, 2) after distance_m (n,) along legs (n,)."""
        index, share = self._locate(leg, distance_m)
        here = self.points[index]
        step = self.points[index + 1] - here
        return here + share[:, None] * step, step / self.spacing_m[leg][:, None]

    def limit(self, leg: Ints, distance_m: Floats) -> Floats:
        """Speed limit [m/s]."""
        limit: Floats = self.limits_mps[self._locate(leg, distance_m)[0]]
        return limit

    def _locate(self, leg: Ints, distance_m: Floats) -> tuple[Ints, Floats]:
        steps = distance_m / self.spacing_m[leg]
        whole = np.maximum(np.floor(steps), 0.0)
        index = np.minimum(self.first[leg] + whole.astype(np.int64), self.last[leg] - 1)
        return index, steps - whole


@dataclass(frozen=True)
class Start:
    """Start: leg, distance along it, payload; joint (2,) and heading in `map`."""

    leg: int
    distance_m: float
    payload_kg: float
    joint_m: Floats
    heading_rad: float


@dataclass(frozen=True)
class Crew:
    """Machine figures, all (n,), named as in `MachineModel`."""

    rear_to_joint_m: Floats
    front_to_joint_m: Floats
    max_articulation_rad: Floats
    mass_kg: Floats
    max_drive_n: Floats
    max_brake_n: Floats
    max_power_w: Floats

    def joint_m(self, state: FleetState) -> Floats:
        """Articulation joint (n, 2), the point that follows the route."""
        x = state.x_m + self.rear_to_joint_m * np.cos(state.yaw_rad)
        return np.stack([x, state.y_m + self.rear_to_joint_m * np.sin(state.yaw_rad)], axis=-1)


def crew_of(models: Sequence[MachineModel]) -> Crew:
    """One driver per machine."""
    return Crew(*(np.array([getattr(model, field.name) for model in models]) for field in fields(Crew)))


def build_course(routes: Sequence[Route], drive_mps: Sequence[float]) -> Course:
    """Prepare one route and one speed per machine."""
    legs = [leg for route in routes for leg in route.legs]
    speeds = [speed for route, speed in zip(routes, drive_mps, strict=True) for _ in route.legs]
    lines = [_beyond(leg) for leg in legs]
    limits = [_limits(leg, speed, len(line)) for leg, speed, line in zip(legs, speeds, lines, strict=True)]
    ends = np.cumsum([len(line) for line in lines])
    counts = np.array([len(route.legs) for route in routes])
    begins = np.cumsum(counts) - counts
    return Course(
        points=np.vstack(lines),
        limits_mps=np.concatenate(limits),
        first=ends - [len(line) for line in lines],
        last=ends - 1,
        spacing_m=np.array([leg.spacing_m for leg in legs]),
        length_m=np.array([leg.length_m for leg in legs]),
        closed=np.array([leg.closed for leg in legs]),
        travel=np.array([-1.0 if leg.reverse else 1.0 for leg in legs]),
        wait_s=np.array([leg.wait_s for leg in legs]),
        payload_kg=np.array([math.nan if leg.payload_kg is None else leg.payload_kg for leg in legs]),
        following=np.concatenate([b + (np.arange(k) + 1) % k for b, k in zip(begins, counts, strict=True)]),
    )


def spread_starts(routes: Sequence[Route], shares: Sequence[float], apart_m: float = 0.0) -> list[Start]:
    """Place one machine per route after a share (0 to 1) of its cycle, moved on until apart_m from the others.

    ValueError if they do not fit.
    """
    starts: list[Start] = []
    begin = 0
    for route, share in zip(routes, shares, strict=True):
        others = np.array([start.joint_m for start in starts]).reshape(-1, 2)
        for moved_m in np.arange(0.0, route.length_m, SPACING_M):
            start = _start(route, begin, share + moved_m / route.length_m)
            if not apart_m or (np.hypot(*(others - start.joint_m).T) >= apart_m).all():
                break
        else:
            raise ValueError(f"the routes have no room for {len(routes)} machines {apart_m:g} m apart")
        starts.append(start)
        begin += len(route.legs)
    return starts


def _start(route: Route, begin: int, share: float) -> Start:
    distance = share % 1.0 * route.length_m
    number = 0
    while number < len(route.legs) - 1 and distance >= route.legs[number].length_m:
        distance -= route.legs[number].length_m
        number += 1
    leg = route.legs[number]
    before = [*route.legs[number:], *route.legs[:number]]
    payload = next((other.payload_kg for other in reversed(before) if other.payload_kg is not None), 0.0)
    index = min(int(distance / leg.spacing_m), len(leg.points) - 1)
    line = _beyond(leg)
    ahead = line[index + 1] - line[index]
    heading = math.atan2(ahead[1], ahead[0]) + math.pi * leg.reverse
    return Start(begin + number, index * leg.spacing_m, payload, line[index], heading)


def _beyond(leg: Leg) -> Floats:
    """Points of a leg extended by BEYOND_M: the next lap, or straight on."""
    more = math.ceil(BEYOND_M / leg.spacing_m)
    if leg.closed:
        return np.take(leg.points, range(len(leg.points) + more), axis=0, mode="wrap")
    step = leg.points[-1] - leg.points[-2]
    return np.vstack([leg.points, leg.points[-1] + np.arange(1, more + 1)[:, None] * step])


def _limits(leg: Leg, drive_mps: float, count: int) -> Floats:
    return np.take(speed_limits(leg, drive_mps), range(count), mode="wrap" if leg.closed else "clip")
