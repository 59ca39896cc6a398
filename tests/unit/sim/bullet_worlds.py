"""Worlds for tests of the physics, fast and in PyBullet: machines on an even plane."""

import math
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from sim.machines.chassis import Bodies
from sim.machines.model import MachineModel, load_model
from sim.state import STEP_S, FleetState
from sim.terrain.terrain import Terrain
from sim.worlds.bullet import BulletWorld
from sim.worlds.fast import FastWorld
from sim.worlds.world import World

LOADER, TRUCK = load_model("wheel_loader"), load_model("dump_truck")
GRADE_15 = math.tan(math.radians(15))
BOTH = pytest.mark.parametrize("model", [LOADER, TRUCK], ids=lambda m: m.name)
EACH = pytest.mark.parametrize("kind", [FastWorld, BulletWorld], ids=["fast", "pybullet"])
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


def hold_speed(world: World, speed: float, seconds: float, steer: float = 0.0) -> list[FleetState]:
    """Drive the only machine of a world at a speed."""
    states, integral = [world.state], 0.0
    for i in range(round(seconds / STEP_S)):
        aim = math.copysign(min(abs(speed), i * STEP_S), speed)
        error = aim - float(states[-1].speed_mps[0])
        integral += 60e3 * STEP_S * error
        states.append(world.advance(np.array([steer]), np.array([50e3 * error + integral]), np.zeros(1)))
    return states


def idle(world: World, seconds: float, brake_n: float = 0.0) -> FleetState:
    n = len(world.state.x_m)
    for _ in range(round(seconds / STEP_S)):
        world.advance(np.zeros(n), np.zeros(n), np.full(n, brake_n))
    return world.state
