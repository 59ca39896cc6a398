"""Simulated seconds per CPU second: drivers, world, all sensors and the truth, but no publishing."""

from __future__ import annotations

import statistics
import time
from dataclasses import dataclass

from lab.speed.measure import Report, machine
from sim.config import SimConfig, resolve
from sim.simulator import Simulator

WARM_UP_S = 1.0  # simulated: compiles, and lets the machines set off


@dataclass(frozen=True)
class FleetCase:
    """A fleet to simulate. goal: simulated seconds per CPU second that are asked for."""

    scenario: str
    world: str
    machines: int
    goal: float

    @property
    def config(self) -> SimConfig:
        """The simulation's options."""
        return SimConfig(scenario=self.scenario, world=self.world, machines=self.machines)


CASES = (
    FleetCase("paper_site", "pybullet", 1, 25.0),
    FleetCase("paper_site", "pybullet", 4, 20.0),
    FleetCase("paper_site", "pybullet", 8, 15.0),
    FleetCase("paper_site", "pybullet", 32, 8.0),
    FleetCase("busy_site", "fast", 100, 40.0),
    FleetCase("busy_site", "fast", 1000, 12.0),
)


def run(seconds: float, runs: int) -> Report:
    """Simulate every fleet for so long, each run in a new world; the median of the runs counts."""
    measured: dict[FleetCase, list[tuple[float, float]]] = {case: [] for case in CASES}
    for _ in range(runs):  # in turn, so that all meet the same disturbances
        for case in CASES:
            measured[case].append(_measure(case, seconds))
    rows = [_row(case, figures) for case, figures in measured.items()]
    return {"benchmark": "sim", "seconds": seconds, "runs": runs, **machine(), "rows": rows}


def _measure(case: FleetCase, seconds: float) -> tuple[float, float]:
    """CPU seconds for starting a simulator, and simulated seconds per CPU second after its warm-up."""
    start_s = time.process_time()
    simulator = Simulator(case.config)
    try:
        up_s = time.process_time()
        _drive(simulator, WARM_UP_S)
        warm_s = time.process_time()
        _drive(simulator, WARM_UP_S + seconds)
        driven_s = simulator.simulated_s - WARM_UP_S  # whole bundles
        return up_s - start_s, driven_s / (time.process_time() - warm_s)
    finally:
        simulator.close()


def _drive(simulator: Simulator, until_s: float) -> None:
    while simulator.simulated_s < until_s:
        simulator.sense()


def _row(case: FleetCase, measured: list[tuple[float, float]]) -> dict[str, str | int | float]:
    start_up_s, pace = (statistics.median(column) for column in zip(*measured, strict=True))
    return {
        "world": case.world,
        "machines": case.machines,
        "give_way": resolve(case.config).give_way,
        "sim_seconds_per_cpu_second": round(pace, 2),
        "goal": case.goal,
        "start_up_cpu_s": round(start_up_s, 3),
    }
