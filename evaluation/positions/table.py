"""The paper's table: every configuration on the same recordings of the paper's site, against the truth.

Poses are all it compares, so only the localising half of the pipeline runs, without ground estimation and sampling;
`us_per_second` is what localisation costs, which is the paper's argument for cheap sensors on a small computer.

A result is one small JSON file beside its recording, named by everything that it depends on: an interrupted run goes on
where it was, and other code or options never meet old results.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from agents.pipeline import Positioning
from evaluation.campaign.recordings import Drive, code_version, digest, gps_error
from evaluation.campaign.tasks import Progress, carry_out, check_name, loaded
from evaluation.positions.configurations import Configuration, UnsupportedError, configure, started_at
from evaluation.positions.replay import Score, Trace, Truth, errors, replay, score
from evaluation.positions.summary import ratios, summarise
from protocol.arrays import Floats

TRACE_S = 1.0  # between two points of the curves that plots draw
RESULT_SOURCES = ("agents", "protocol", "evaluation/positions/replay.py", "evaluation/positions/consistency.py")


@dataclass(frozen=True)
class Plan:
    """What to run. cache: folder of recordings and results. processes: how many at a time."""

    seeds: tuple[int, ...]
    seconds: float
    rows: tuple[Configuration, ...]
    cache: Path
    processes: int
    preset: str = "paper"

    @property
    def drives(self) -> tuple[Drive, ...]:
        """The recordings."""
        return tuple(Drive(seed, self.seconds, self.preset) for seed in self.seeds)


@dataclass(frozen=True)
class Task:
    """One configuration on one recording."""

    drive: Drive
    row: Configuration
    cache: Path


@dataclass(frozen=True)
class Curves:
    """One run once per TRACE_S, for plots: time (n,) [s], position and error (n, 2) [m], standard deviation (n,) [m].

    The standard deviation is that along the ellipse's longer axis.
    """

    time_s: Floats
    position_m: Floats
    error_m: Floats
    std_m: Floats


@dataclass(frozen=True)
class Outcome:
    """What became of one task."""

    task: Task
    score: Score
    curves: Curves


def run(plan: Plan, on_progress: Progress = lambda *_: None) -> tuple[dict[str, Any], list[Outcome]]:
    """Record, replay and score everything of a plan; returns the report in plain values, and the outcomes.

    The report has `rows`, one per configuration; `ratios`, paired on the same recordings; `missing`, what the pipeline
    cannot run and why; `gps_error`, how slow the simulated errors are.
    """
    runnable, missing = _sort_out(plan)
    outcomes = _outcomes(plan, runnable, on_progress)
    scores = {row: [o.score for o in outcomes if o.task.row == row] for row in runnable}
    report = {
        "scenario": "paper_site",
        "gps_error": gps_error(plan.preset),
        "seeds": list(plan.seeds),
        "seconds": plan.seconds,
        "rows": [summarise(row, found) for row, found in scores.items()],
        "ratios": ratios(scores),
        "missing": missing,
    }
    return report, outcomes


def _sort_out(plan: Plan) -> tuple[list[Configuration], list[dict[str, Any]]]:
    """Rows that the pipeline can run, and those that it cannot with the reason."""
    machine = plan.drives[0].machine
    runnable, missing = [], []
    for row in plan.rows:
        try:
            configure(machine, row)
            runnable.append(row)
        except UnsupportedError as error:
            missing.append({**asdict(row), "why": str(error)})
    return runnable, missing


def _outcomes(plan: Plan, rows: Sequence[Configuration], on_progress: Progress) -> list[Outcome]:
    """Outcomes of all tasks, in the order of rows and seeds, from the cache where they are there."""
    tasks = [Task(drive, row, plan.cache) for drive in plan.drives for row in rows]
    carry_out(tasks, result_file, _replay, plan.processes, on_progress)
    return [read_outcome(task) for task in tasks]


def result_file(task: Task) -> Path:
    """Where the outcome of a task is kept."""
    key = digest(repr(configure(task.drive.machine, task.row)), code_version(*RESULT_SOURCES))
    return task.drive.folder(task.cache) / "results" / f"{task.row.name}-{key}.json"


def read_outcome(task: Task) -> Outcome:
    """Read what a worker wrote."""
    kept = json.loads(result_file(task).read_text(encoding="utf-8"))
    curves = Curves(**{name: np.array(values, float) for name, values in kept["curves"].items()})
    return Outcome(task, Score(**{name: math.nan if v is None else v for name, v in kept["score"].items()}), curves)


# --- in the worker processes -----------------------------------------------------------------------------------------


def _replay(job: tuple[Task, Path]) -> None:
    """Run one configuration on one recording, and write its outcome, whole or not at all."""
    task, file = job
    check_name(file, result_file(task))
    recording = loaded(task.drive, task.cache)
    machine, options = configure(recording.machine, task.row)
    if not task.row.gps:
        options = started_at(options, recording.start)
    in_use = {sensor.name for sensor in machine.sensors if sensor.use}
    readings = [reading for reading in recording.readings if reading.sensor in in_use]
    trace = replay(Positioning(recording.site, machine, options), readings)
    outcome = {"score": asdict(score(trace, recording.truth)), "curves": _thin(trace, recording.truth)}
    file.parent.mkdir(exist_ok=True)
    part = file.with_suffix(".part")
    part.write_text(json.dumps(_without_nan(outcome), allow_nan=False), encoding="utf-8")
    part.rename(file)


def _thin(trace: Trace, truth: Truth) -> dict[str, Any]:
    """Points for the curves of plots, rounded to millimetres."""
    seconds = trace.since_start_s
    _, pick = np.unique(seconds // TRACE_S, return_index=True)
    deviation = np.sqrt(np.linalg.eigvalsh(trace.covariance_m2[pick])[:, -1]) if len(pick) else np.empty(0)
    columns = {
        "time_s": seconds[pick],
        "position_m": trace.position_m[pick],
        "error_m": errors(trace, truth)[pick],
        "std_m": deviation,
    }
    return {name: np.round(values, 3).tolist() for name, values in columns.items()}


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nan(v) for key, v in value.items()}
    if isinstance(value, list):
        return [_without_nan(v) for v in value]
    return None if isinstance(value, float) and math.isnan(value) else value
