"""Simulated seconds per CPU second: drivers, world, sensors, truth; no publishing."""

from __future__ import annotations

import time
from collections.abc import Iterator
from functools import partial

from lab.speed.measure import in_turn, rows_of
from sim.config import SimConfig
from sim.simulator import Simulator
from sitegrid.proof.figures import Row

OPTIONS = {"runs": 5, "seconds": 20.0}
WARM_UP_S = 1.0  # simulated: compiles, starts the machines
PACE = "sim_s_per_cpu_s"
# Scenario, world, machines, goal.
FLEETS = (
    ("paper_site", "pybullet", 1, 25.0),
    ("paper_site", "pybullet", 4, 20.0),
    ("paper_site", "pybullet", 8, 15.0),
    ("paper_site", "pybullet", 32, 8.0),
    ("busy_site", "fast", 100, 40.0),
    ("busy_site", "fast", 1000, 12.0),
)


def case_of(world: str, machines: int) -> str:
    """Name of a fleet."""
    return f"{world}, {machines}"


GOALS = {(case_of(world, machines), PACE): f">= {goal:g}" for _, world, machines, goal in FLEETS}


def run(seconds: float, runs: int) -> Iterator[Row]:
    """Simulate every fleet, each run in a new world, in turn."""
    variants = {
        case_of(world, machines): partial(_simulated, SimConfig(scenario=name, world=world, machines=machines), seconds)
        for name, world, machines, _ in FLEETS
    }
    for case, figures in in_turn(variants, runs).items():
        yield from rows_of(case, figures)


def _simulated(config: SimConfig, seconds: float) -> dict[str, float]:
    """Simulated seconds per CPU second after warm-up, and CPU seconds to start."""
    start_s = time.process_time()
    simulator = Simulator(config)
    try:
        up_s = time.process_time()
        _drive(simulator, WARM_UP_S)
        warm_s = time.process_time()
        _drive(simulator, WARM_UP_S + seconds)
        driven_s = simulator.simulated_s - WARM_UP_S  # whole bundles
        return {PACE: driven_s / (time.process_time() - warm_s), "start_up_cpu_s": up_s - start_s}
    finally:
        simulator.close()


def _drive(simulator: Simulator, until_s: float) -> None:
    while simulator.simulated_s < until_s:
        simulator.sense()
