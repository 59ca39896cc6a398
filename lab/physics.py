"""How far the simulator can be trusted: experiments whose outcome mechanics gives, and tours in both of its worlds."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from protocol.arrays import Floats
from protocol.units import GRAVITY_MPS2
from sim.config import SimConfig
from sim.machines.chassis import Bodies
from sim.machines.model import load_model
from sim.scenario.file import load_scenario
from sim.simulator import Simulator
from sim.state import STEP_S, FleetState, stack
from sim.terrain.soil import CONCRETE, GRAVEL, SOILS, WET_DIRT
from sim.terrain.terrain import Terrain
from sim.worlds.bullet import BulletWorld
from sim.worlds.fast import FastWorld
from sim.worlds.world import World

WORLDS: dict[str, type[BulletWorld] | type[FastWorld]] = {"pybullet": BulletWorld, "fast": FastWorld}
GRADE_15 = math.tan(math.radians(15))
LOADER = load_model("wheel_loader")
SPEED_MPS = 2.0
TOUR_S = 125.0  # a lap of the longest tour of the paper's site

Row = dict[str, Any]


def run(seeds: Sequence[int], on_progress: Callable[[str], None] = lambda _: None) -> dict[str, Any]:
    """Do all experiments in both worlds, and drive each tour of the paper's site once per seed.

    Returns one object with `rows` (experiment, world, measured, expected, error, unit, goal) and `tours`.
    """
    return {"rows": experiments(on_progress), "tours": tours(seeds, on_progress)}


def experiments(on_progress: Callable[[str], None]) -> list[Row]:
    """Do all experiments in both worlds."""
    rows: list[Row] = []
    for name in WORLDS:
        for experiment in (_traction, _slope, _coast_down, _parking, _circle):
            on_progress(f"{name}: {experiment.__name__.strip('_').replace('_', ' ')}")
            rows += [{"experiment": experiment.__name__.strip("_"), "world": name, **row} for row in experiment(name)]
    return rows


def tours(seeds: Sequence[int], on_progress: Callable[[str], None]) -> list[Row]:
    """Drive each tour of the paper's site once per seed, in both worlds."""
    rows = []
    for seed in seeds:
        for route in load_scenario("paper_site").route:
            on_progress(f"tour {route.name}, seed {seed}")
            rows.append({"route": route.name, "seed": seed, **_apart(route.name, seed)})
    return rows


def _traction(world: str) -> list[Row]:
    """Drive force over load at a steady speed on the level."""
    rows = []
    for zone, soil in enumerate(SOILS):
        with _alone(world, _plane(zone)) as one:
            last = _hold(one, 10.0)[-1]
        rows.append(_row(soil.name, _pull(last), soil.c_rr, "F/N", relative=0.01))
    return rows


def _slope(world: str) -> list[Row]:
    """Drive force over load on 15 degrees."""
    rows = []
    for case, grade in (("uphill", GRADE_15), ("downhill", -GRADE_15)):
        with _alone(world, _plane(WET_DIRT, grade)) as one:
            last = _hold(one, 10.0)[-1]
        rows.append(_row(case, _pull(last), SOILS[WET_DIRT].c_rr + grade, "F/N", absolute=0.002))
    return rows


def _coast_down(world: str) -> list[Row]:
    """Deceleration when the engine lets go."""
    turning = 1 + 4 * LOADER.wheel_inertia_kgm2 / LOADER.wheel_radius_m**2 / LOADER.mass_kg
    with _alone(world, _plane(GRAVEL)) as one:
        _hold(one, 8.0)
        start = float(_roll_out(one, 1.2)[-1].speed_mps[0])  # until the engine has let go
        slower = (start - float(_roll_out(one, 0.5)[-1].speed_mps[0])) / 0.5
    return [_row("gravel", slower, SOILS[GRAVEL].c_rr * GRAVITY_MPS2 / turning, "m/s2", relative=0.01)]


def _parking(world: str) -> list[Row]:
    """Creep in 30 s on 15 degrees with the brakes on."""
    with _alone(world, _plane(CONCRETE, GRADE_15)) as one:
        run = stack(_roll_out(one, 30.0, LOADER.max_brake_n))
    creep = math.hypot(run.x_m[-1, 0] - run.x_m[0, 0], run.y_m[-1, 0] - run.y_m[0, 0])
    return [_row("concrete, 15 deg, 30 s", creep, 0.0, "m", absolute=0.01)]


def _circle(world: str) -> list[Row]:
    """Radius of the rear axle's circle at a fixed articulation."""
    rows = []
    for angle in (0.2, 0.5):
        with _alone(world, _plane(CONCRETE)) as one:
            run = stack(_hold(one, 20.0, angle)[700:])
        x, y = run.x_m[:, 0], run.y_m[:, 0]
        # algebraic circle fit: x^2 + y^2 = 2 a x + 2 b y + c
        a, b, c = np.linalg.lstsq(np.stack([2 * x, 2 * y, np.ones_like(x)], 1), x**2 + y**2, rcond=None)[0]
        expected = (LOADER.front_to_joint_m + LOADER.rear_to_joint_m * math.cos(angle)) / math.sin(angle)
        rows.append(_row(f"{angle:g} rad", math.sqrt(c + a * a + b * b), expected, "m", relative=0.02))
    return rows


def _apart(route: str, seed: int) -> Row:
    """How far both worlds part on one tour, driven alone."""
    one, other = (_tour(route, seed, world) for world in WORLDS)
    apart, faster = np.hypot(one.x_m - other.x_m, one.y_m - other.y_m), one.speed_mps - other.speed_mps
    position_rms_m, speed_rms_mps = (float(np.sqrt((difference**2).mean())) for difference in (apart, faster))
    figures = {"position_rms_m": position_rms_m, "position_max_m": float(apart.max()), "speed_rms_mps": speed_rms_mps}
    return {name: round(value, 4) for name, value in figures.items()}


def _tour(route: str, seed: int, world: str) -> FleetState:
    scenario = load_scenario("paper_site")
    fleet = replace(scenario.fleet[0], count=1, routes=(route,))
    config = SimConfig(world=world, seed=seed)
    with closing(Simulator(config, replace(scenario, world=world, seed=seed, fleet=(fleet,)))) as simulator:
        return stack([simulator.step() for _ in range(round(TOUR_S / STEP_S))])


# --- one machine on a plane ------------------------------------------------------------------------------------------


def _plane(zone: int, grade_east: float = 0.0) -> Terrain:
    x, _ = np.meshgrid([0.0, 1000.0], [0.0, 1000.0])
    return Terrain(grade_east * x, 1000.0, np.full((1, 1), zone), 1000.0)


@contextmanager
def _alone(world: str, terrain: Terrain) -> Iterator[World]:
    body = Bodies(np.array([LOADER.mass_kg]), np.array([LOADER.wheel_radius_m]))
    one: World = WORLDS[world](terrain, [LOADER], body, np.array([[500.0, 500.0, 0.0]]))
    with closing(one):
        yield one


def _hold(world: World, seconds: float, steer_rad: float = 0.0) -> list[FleetState]:
    """Drive at SPEED_MPS, by a speed controller of its own."""
    states, integral = [world.state], 0.0
    for i in range(round(seconds / STEP_S)):
        error = min(SPEED_MPS, i * STEP_S) - float(states[-1].speed_mps[0])
        integral += 60e3 * STEP_S * error
        states.append(world.advance(np.array([steer_rad]), np.array([50e3 * error + integral]), np.zeros(1)))
    return states


def _roll_out(world: World, seconds: float, brake_n: float = 0.0) -> list[FleetState]:
    zero: Floats = np.zeros(1)
    return [world.advance(zero, zero, np.full(1, brake_n)) for _ in range(round(seconds / STEP_S))]


def _pull(state: FleetState) -> float:
    return float(state.torque_nm[0] / LOADER.wheel_radius_m / state.load_n[0])


def _row(
    case: str, measured: float, expected: float, unit: str, *, relative: float = 0.0, absolute: float = 0.0
) -> Row:
    error, goal = abs(measured - expected), absolute or relative * abs(expected)
    row = {"case": case, "measured": round(measured, 6), "expected": round(expected, 6), "error": round(error, 6)}
    return row | {"unit": unit, "goal": round(goal, 6), "met": error <= goal}
