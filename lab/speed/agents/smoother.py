"""What localisation costs with and without the smoother: percent of a core, of the readings that an agent gets."""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import partial

from agents.localisation.localiser import LocalisationConfig
from agents.positioning import PipelineConfig, Positioning
from lab.speed.agents.agent import SITE, bundles, machine
from lab.speed.measure import Report, medians
from protocol.machine.readings import Reading

SECONDS = 150  # the window is full for the last minute
LAGS_S = (0.0, 90.0)


def measured(runs: int) -> list[Report]:
    """A row per filter: localisation alone, and what the smoother adds; the median of the runs counts."""
    fed = list(bundles(SECONDS))
    rows = []
    for name in ("ekf", "ukf"):
        seconds = medians({f"{lag_s:g}": partial(_cpu_s, fed, name, lag_s) for lag_s in LAGS_S}, runs)
        without, with_it = (100 * seconds[f"{lag_s:g}"] / SECONDS for lag_s in LAGS_S)
        costs = {"cpu_percent": round(with_it, 3), "smoother_percent": round(with_it - without, 3)}
        rows.append({"filter": name, "lag_s": LAGS_S[1], **costs})
    return rows


def _cpu_s(fed: Sequence[Sequence[Reading]], name: str, lag_s: float) -> float:
    """Processor time of a whole drive."""
    config = PipelineConfig(localisation=LocalisationConfig(filter=name, lag_s=lag_s))
    positioning = Positioning(SITE, machine(), config)
    began_s = time.process_time()
    for readings in fed:
        positioning.step(readings)
    return time.process_time() - began_s
