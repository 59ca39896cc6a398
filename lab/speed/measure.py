"""What the benchmarks share: samples to measure with, and variants measured in turn."""

from __future__ import annotations

import json
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from protocol.arrays import Table
from protocol.machine.samples import empty

Report = dict[str, Any]
START_NS = 1_767_225_600_000_000_000
SIDE_M = 1024.0  # of the site; three sums for each of its cells of 1 m take 25 MB, more than a cache holds


def track(n: int, seed: int = 0) -> Table:
    """Samples half a metre apart along a winding drive, as a machine at work sends them."""
    draw = np.random.default_rng(seed)
    heading = np.cumsum(draw.normal(0.0, 0.05, n))
    x, y = (SIDE_M / 2 + np.cumsum(0.5 * part(heading)) for part in (np.cos, np.sin))
    return _fill(n, draw, x % SIDE_M, y % SIDE_M, heading)


def scattered(n: int, seed: int = 0) -> Table:
    """Samples anywhere on the site, as an archive of many machines is folded."""
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


def medians(variants: Mapping[str, Callable[[], float]], runs: int) -> dict[str, float]:
    """Median of each variant's figure [s]; one run of each in turn, so that all meet the same disturbances."""
    seconds: dict[str, list[float]] = {name: [] for name in variants}
    for _ in range(runs):
        for name, variant in variants.items():
            seconds[name].append(variant())
    return {name: statistics.median(figures) for name, figures in seconds.items()}


def timed(work: Callable[[], object]) -> float:
    """Seconds that the work took."""
    start_s = time.perf_counter()
    work()
    return time.perf_counter() - start_s


def memory_mb(name: str = "VmRSS", pid: int | None = None) -> float:
    """Memory of this process or another: resident now, or with VmHWM the most that ever was.

    getrusage would count a parent's too.
    """
    lines = Path(f"/proc/{pid or 'self'}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(name)) * 1024 / 1e6


def in_child(module: str, *words: str) -> Report:
    """What a module prints as one JSON object when it runs in a process of its own."""
    command, root = [sys.executable, "-m", module, *words], Path(__file__).parent.parent
    result: Report = json.loads(subprocess.run(command, cwd=root, check=True, capture_output=True).stdout)  # noqa: S603
    return result


def machine() -> dict[str, Any]:
    """What the figures were measured on."""
    return {"python": platform.python_version(), "numpy": np.__version__, "cores": os.cpu_count()}
