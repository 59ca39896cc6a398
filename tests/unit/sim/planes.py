"""Both worlds for physics tests: machines on an even plane."""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import ArrayLike

from sim.machines.chassis import Bodies
from sim.machines.model import MachineModel, load_model
from sim.state import STEP_S, FleetState
from sim.terrain.terrain import CONCRETE, Terrain
from sim.worlds.bullet import BulletWorld
from sim.worlds.fast import FastWorld
from sim.worlds.world import World

LOADER, TRUCK = load_model("wheel_loader"), load_model("dump_truck")
GRADE_15 = math.tan(math.radians(15))
BOTH = pytest.mark.parametrize("model", [LOADER, TRUCK], ids=lambda m: m.name)
# Laws of both worlds. Slow PyBullet cases that rarely fail alone run by night.
EACH_ALWAYS = pytest.mark.parametrize("kind", [FastWorld, BulletWorld], ids=["fast", "pybullet"])
EACH = pytest.mark.parametrize(
    "kind", [FastWorld, pytest.param(BulletWorld, marks=pytest.mark.nightly)], ids=["fast", "pybullet"]
)
MIDDLE = ((500.0, 500.0, 0.0),)


def plane(zone: int, grade_east: float = 0.0, grade_north: float = 0.0) -> Terrain:
    x, y = np.meshgrid([0.0, 1000.0], [0.0, 1000.0])
    return Terrain(grade_east * x + grade_north * y, 1000.0, np.full((1, 1), zone), 1000.0)


def nominal(*models: MachineModel) -> Bodies:
    return Bodies(np.array([m.mass_kg for m in models]), np.array([m.wheel_radius_m for m in models]))


@contextmanager
def placed(kind: type, terrain: Terrain, *models: MachineModel, starts: object = MIDDLE) -> Iterator[World]:
    world = kind(terrain, models, nominal(*models), np.array(starts))
    try:
        yield world
    finally:
        world.close()


class Lane(NamedTuple):
    """A machine's soil and heading."""

    model: MachineModel = LOADER
    zone: int = CONCRETE
    yaw: float = 0.0


@contextmanager
def lanes(kind: type, lanes: Sequence[Lane], grade_east: float = 0.0) -> Iterator[World]:
    """Machines side by side, 100 m apart: one world is cheaper than one each."""
    zones = np.array([[lane.zone] for lane in lanes])
    terrain = replace(plane(0, grade_east), zones=zones, zone_cell_m=100.0)
    starts = [(500.0, 100.0 * i + 50.0, lane.yaw) for i, lane in enumerate(lanes)]
    with placed(kind, terrain, *(lane.model for lane in lanes), starts=starts) as world:
        yield world


def of_each(lanes: Sequence[Lane], name: str) -> np.ndarray:
    """A model value, (n,)."""
    return np.array([getattr(lane.model, name) for lane in lanes])


def cruise(world: World, speed: ArrayLike, seconds: float, steer: ArrayLike = 0.0) -> list[FleetState]:
    """Drive a world's machines at given speeds."""
    states, integral, zero = [world.state], 0.0, np.zeros(len(world.state.x_m))
    for i in range(round(seconds / STEP_S)):
        aim = np.clip(speed, -i * STEP_S, i * STEP_S)
        error = aim - states[-1].speed_mps
        integral = integral + 60e3 * STEP_S * error
        states.append(world.advance(zero + steer, 50e3 * error + integral, zero))
    return states


def idle(world: World, seconds: float, brake_n: ArrayLike = 0.0) -> FleetState:
    """Let a world's machines roll or stand."""
    zero = np.zeros(len(world.state.x_m))
    for _ in range(round(seconds / STEP_S)):
        world.advance(zero, zero, zero + brake_n)
    return world.state
