"""The paper's table: every configuration on the same recordings of the paper's site, against the truth.

Poses are all it compares, so only the localising half of the pipeline runs, without ground estimation and sampling;
`us_per_second` is what localisation costs, which is the paper's argument for cheap sensors on a small computer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from agents.pipeline import Positioning
from evaluation.campaign.experiment import Experiment, Runner, Task, replay_task
from evaluation.campaign.recordings import PAPER, PlannedDrive, Setup
from evaluation.positions.configurations import Configuration, UnsupportedError, configure, started_at
from evaluation.positions.replay import Score, errors, replay, score
from evaluation.positions.summary import RatioRow, TableRow, ratios, summarise
from protocol.arrays import Floats
from sim.sensors.presets import load_preset

TRACE_S = 1.0  # between two points of the curves that plots draw
SOURCES = (
    "agents",
    "protocol",
    *(f"evaluation/positions/{part}.py" for part in ("table", "configurations", "replay", "consistency")),
)


@dataclass(frozen=True)
class ScoredRun(Score):
    """A score, and the run once per TRACE_S, for plots.

    time_s: (n,); position_m, error_m: (n, 2); std_m: (n,), stated, along the longer axis of the ellipse.
    """

    time_s: Floats
    position_m: Floats
    error_m: Floats
    std_m: Floats


@dataclass(frozen=True)
class Outcome:
    """One configuration on one recording."""

    drive: PlannedDrive
    row: Configuration
    run: ScoredRun


@dataclass(frozen=True)
class MissingRow(Configuration):
    """A configuration that the pipeline cannot run, and why."""

    why: str


@dataclass(frozen=True)
class TableReport:
    """The table. rows: one per configuration; ratios: paired on the same recordings."""

    scenario: str
    gps_error: dict[str, Any]
    seeds: list[int]
    seconds: float
    rows: list[TableRow]
    ratios: list[RatioRow]
    missing: list[MissingRow]


def run(
    runner: Runner, seeds: Sequence[int], seconds: float, rows: Sequence[Configuration], setup: Setup = PAPER
) -> tuple[TableReport, list[Outcome]]:
    """Record, replay and score all configurations with all seeds."""
    drives = [PlannedDrive(seed, seconds, setup=setup) for seed in seeds]
    runnable, missing = _sort_out(drives[0], rows)
    pairs = [(drive, row) for drive in drives for row in runnable]
    runs = runner.run(EXPERIMENT, [replay_task(row, drive) for drive, row in pairs])
    outcomes = [Outcome(*pair, run) for pair, run in zip(pairs, runs, strict=True)]
    scores = {row: [o.run for o in outcomes if o.row == row] for row in runnable}
    table = [summarise(row, several) for row, several in scores.items()]
    error = gps_error(drives[0].preset)
    return TableReport(setup.scenario, error, list(seeds), seconds, table, ratios(scores), missing), outcomes


def gps_error(preset: str) -> dict[str, Any]:
    """How slow the GPS errors of a preset are: on white noise every filter looks wonderful."""
    gps = load_preset(preset).gps
    slow, white = gps.drift_std_m**2, gps.white_std_m**2
    return {
        "preset": preset,
        "rms_2d_m": round((2 * (slow + white)) ** 0.5 * gps.scale, 3),
        "slow_variance_share": round(slow / (slow + white), 3),
        "correlation_time_s": gps.drift_time_s,
        **{name: getattr(gps, name) for name in ("rate_hz", "shared", "outage_s", "outage_period_s")},
    }


def _sort_out(drive: PlannedDrive, rows: Sequence[Configuration]) -> tuple[list[Configuration], list[MissingRow]]:
    """Rows that the pipeline can run, and those that it cannot with the reason."""
    runnable, missing = [], []
    for row in rows:
        try:
            configure(drive.machine, row)
            runnable.append(row)
        except UnsupportedError as error:
            missing.append(MissingRow(**vars(row), why=str(error)))
    return runnable, missing


# --- in the worker processes -----------------------------------------------------------------------------------------


def _replay(task: Task[Configuration], cache: Path) -> ScoredRun:
    """Run one configuration on one recording."""
    recording = task.recording(cache)
    machine, options = configure(recording.machine, task.variant)
    if not task.variant.gps:
        options = started_at(options, recording.start)
    in_use = {sensor.name for sensor in machine.sensors if sensor.use}
    readings = [reading for reading in recording.readings if reading.sensor in in_use]
    trace = replay(Positioning(recording.site, machine, options), readings)
    _, pick = np.unique(trace.since_start_s // TRACE_S, return_index=True)
    variances = np.linalg.eigvalsh(trace.covariance_m2[pick])
    return ScoredRun(
        **vars(score(trace, recording.truth)),
        time_s=trace.since_start_s[pick],
        position_m=trace.position_m[pick],
        error_m=errors(trace, recording.truth)[pick],
        std_m=np.sqrt(variances[:, -1]),
    )


EXPERIMENT = Experiment("localisation", ScoredRun, SOURCES, _replay)
