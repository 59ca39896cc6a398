"""Shared by the loads: rows of figures, variants in turn, test samples, child processes."""

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
DIGITS = 4  # significant digits
SIDE_M = 1024.0  # of the site; three sums per 1 m cell take 25 MB, more than a cache
Figures = Mapping[str, float | None]  # of one case by name; None: not installed
Goals = Mapping[tuple[str, str], str]  # by case and figure: "<= 150", ">= 0.9"


def rows_of(case: str, figures: Figures) -> Iterator[Row]:
    """A row per figure of a case."""
    for name, value in figures.items():
        yield {"case": case, "figure": name, "value": None if value is None else float(f"{value:.{DIGITS}g}")}


def judged(rows: Iterable[Row], goals: Goals) -> list[Row]:
    """Add each row's goal (None: none) and verdict."""
    return [row | _judgement(row["value"], goals.get((row["case"], row["figure"]))) for row in rows]


def _judgement(value: float | None, goal: str | None) -> Row:
    if goal is None:
        return {"goal": None, "met": None}
    relation, limit = goal.split()
    met = value is not None and (value <= float(limit) if relation == "<=" else value >= float(limit))
    return {"goal": goal, "met": met}


def in_turn(variants: Mapping[str, Callable[[], Figures]], runs: int) -> dict[str, dict[str, float]]:
    """Median of each variant's figures; runs alternate, so that disturbances hit all alike."""
    measured: dict[str, list[Figures]] = {name: [] for name in variants}
    for _ in range(runs):
        for name, variant in variants.items():
            measured[name].append(variant())
    return {
        name: {figure: statistics.median(float(run[figure] or 0.0) for run in each) for figure in each[0]}
        for name, each in measured.items()
    }


def timed(work: Callable[[], object]) -> dict[str, float]:
    """Duration: `wall_s`, and this process's `cpu_s`."""
    start_s, start_cpu_s = time.perf_counter(), time.process_time()
    work()
    return {"wall_s": time.perf_counter() - start_s, "cpu_s": time.process_time() - start_cpu_s}


def track(n: int, seed: int = 0) -> Table:
    """Samples (n,) 0.5 m apart on a winding drive, like a working machine's."""
    draw = np.random.default_rng(seed)
    heading = np.cumsum(draw.normal(0.0, 0.05, n))
    x, y = (SIDE_M / 2 + np.cumsum(0.5 * part(heading)) for part in (np.cos, np.sin))
    return _fill(n, draw, x % SIDE_M, y % SIDE_M, heading)


def scattered(n: int, seed: int = 0) -> Table:
    """Samples (n,) anywhere on the site, like an archive of many machines."""
    draw = np.random.default_rng(seed)
    x, y = draw.uniform(0.0, SIDE_M, (2, n))
    return _fill(n, draw, x, y, draw.uniform(-np.pi, np.pi, n))


def _fill(n: int, draw: np.random.Generator, x: Any, y: Any, heading: Any) -> Table:
    """Correlated position errors of 1.3 m per axis; 10 ms apart, like a fleet of 16."""
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
    """The JSON object printed by a module in its own process."""
    command = [sys.executable, "-m", module, *words]
    result: dict[str, Any] = json.loads(subprocess.run(command, cwd=ROOT, check=True, capture_output=True).stdout)  # noqa: S603
    return result


@contextmanager
def child(module: str, *words: str, end_s: float = 0.0) -> Iterator[list[Figures]]:
    """Run a module that prints `ready`; after the block, its final JSON object.

    end_s: timeout for its end; 0: it prints nothing and is terminated.
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
    """Print progress, and what could not be measured."""
    print(what, file=sys.stderr, flush=True)


def machine() -> dict[str, Any]:
    """The measuring environment."""
    return {"python": platform.python_version(), "numpy": np.__version__, "cores": os.cpu_count()}
