"""What the loads share: rows of figures, variants measured in turn, samples to measure with, child processes."""

from __future__ import annotations

import json
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from protocol.arrays import Table
from protocol.machine.samples import empty
from sitegrid.proof.figures import Row
from tests.site_work import START_NS

ROOT = Path(__file__).parents[2]
DIGITS = 4  # significant, of every figure
SIDE_M = 1024.0  # of the site; three sums for each of its cells of 1 m take 25 MB, more than a cache holds
Figures = Mapping[str, float | None]  # of one case, by name; None where something is not installed
Goals = Mapping[tuple[str, str], str]  # by case and figure: "<= 150", ">= 0.9"


def rows_of(case: str, figures: Figures) -> Iterator[Row]:
    """A row per figure of a case."""
    for name, value in figures.items():
        yield {"case": case, "figure": name, "value": None if value is None else float(f"{value:.{DIGITS}g}")}


def judged(rows: Iterable[Row], goals: Goals) -> list[Row]:
    """Rows with the goal of each, None where it has none, and whether it is met."""
    return [row | _judgement(row["value"], goals.get((row["case"], row["figure"]))) for row in rows]


def _judgement(value: float | None, goal: str | None) -> Row:
    if goal is None:
        return {"goal": None, "met": None}
    relation, limit = goal.split()
    met = value is not None and (value <= float(limit) if relation == "<=" else value >= float(limit))
    return {"goal": goal, "met": met}


def in_turn(variants: Mapping[str, Callable[[], Figures]], runs: int) -> dict[str, dict[str, float]]:
    """Median of each figure of each variant; one run of each in turn, so that all meet the same disturbances."""
    measured: dict[str, list[Figures]] = {name: [] for name in variants}
    for _ in range(runs):
        for name, variant in variants.items():
            measured[name].append(variant())
    return {
        name: {figure: statistics.median(float(run[figure] or 0.0) for run in each) for figure in each[0]}
        for name, each in measured.items()
    }


def timed(work: Callable[[], object]) -> dict[str, float]:
    """Seconds that work took: `wall_s` by the clock, `cpu_s` of this process."""
    start_s, start_cpu_s = time.perf_counter(), time.process_time()
    work()
    return {"wall_s": time.perf_counter() - start_s, "cpu_s": time.process_time() - start_cpu_s}


def track(n: int, seed: int = 0) -> Table:
    """Samples (n,) half a metre apart along a winding drive, as a machine at work sends them."""
    draw = np.random.default_rng(seed)
    heading = np.cumsum(draw.normal(0.0, 0.05, n))
    x, y = (SIDE_M / 2 + np.cumsum(0.5 * part(heading)) for part in (np.cos, np.sin))
    return _fill(n, draw, x % SIDE_M, y % SIDE_M, heading)


def scattered(n: int, seed: int = 0) -> Table:
    """Samples (n,) anywhere on the site, as an archive of many machines is folded."""
    draw = np.random.default_rng(seed)
    x, y = draw.uniform(0.0, SIDE_M, (2, n))
    return _fill(n, draw, x, y, draw.uniform(-np.pi, np.pi, n))


def _fill(n: int, draw: np.random.Generator, x: Any, y: Any, heading: Any) -> Table:
    """1.3 m of position error per axis, correlated; 10 ms apart, as from a fleet of 16 machines."""
    rows = empty(n)
    rows["stamp_ns"] = START_NS + np.arange(n) * 10**7
    rows["x_m"], rows["y_m"], rows["heading_rad"] = x, y, (heading + np.pi) % (2 * np.pi) - np.pi
    rows["cov_xx_m2"] = rows["cov_yy_m2"] = 1.3**2
    rows["cov_xy_m2"] = draw.uniform(-0.8, 0.8, n) * 1.3**2
    rows["distance_m"], rows["speed_mps"] = 0.5, 5.0
    rows["c_rr"] = draw.normal(0.04, 0.005, n)
    rows["grade_e"], rows["grade_n"] = draw.normal(0.0, 0.05, (2, n))
    return rows


def in_child(module: str, *words: str) -> dict[str, Any]:
    """What a module prints as one JSON object when it runs in a process of its own."""
    command = [sys.executable, "-m", module, *words]
    result: dict[str, Any] = json.loads(subprocess.run(command, cwd=ROOT, check=True, capture_output=True).stdout)  # noqa: S603
    return result


@contextmanager
def child(module: str, *words: str, end_s: float = 0.0) -> Iterator[list[Figures]]:
    """A module in a process of its own that prints `ready`; once left, the JSON object that it prints in the end.

    end_s: how long it may take from then on; 0 for one that prints nothing and is ended.
    """
    printed: list[Figures] = []
    command = [sys.executable, "-m", module, *words]
    with subprocess.Popen(command, stdout=subprocess.PIPE, cwd=ROOT, text=True) as process:  # noqa: S603
        try:
            if process.stdout is None or "ready" not in process.stdout.readline():
                raise RuntimeError(f"{module} did not start: nothing was measured")
            yield printed
            if end_s:
                printed.append(json.loads(process.communicate(timeout=end_s)[0]))
        finally:
            process.terminate()


def say(what: str) -> None:
    """Progress, and what could not be measured."""
    print(what, file=sys.stderr, flush=True)


def machine() -> dict[str, Any]:
    """What the figures were measured on."""
    return {"python": platform.python_version(), "numpy": np.__version__, "cores": os.cpu_count()}
