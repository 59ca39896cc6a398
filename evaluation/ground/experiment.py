"""How well rolling resistance and gradient are estimated: loaders at work, every row on the same recordings.

Readings of a recording become samples in the whole pipeline; samples are kept beside the recording, named by everything
that they depend on, so that an interrupted run goes on where it was. Judging them takes a moment and is done anew.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from agents.estimation.ground import EstimationConfig
from agents.pipeline import Pipeline, PipelineConfig
from agents.sampling import LAG_S
from evaluation.campaign.recordings import Drive, Recording, Setup, code_version, digest, track_file
from evaluation.campaign.tasks import Progress, carry_out, check_name, loaded
from evaluation.ground.score import Judged, by_border, c_rr_bias, figures, judge, pool, soils
from evaluation.ground.truth import Ground, Way, lay_ground, read_way
from evaluation.positions.summary import half_width, rounded
from protocol.arrays import Floats, Table

LOADING = Setup("loading", ("west", "east", "middle", "yard"), gps=(1, 2), imu=(3,))
ESTIMATORS = ("kalman", "rls")
# Preset of a row -> preset of the simulator, and whether the machine calibrates itself by its work.
PRESETS = {"nominal": ("dgps", False), "calibrated": ("dgps", True), "harsh": ("harsh", True)}
# Not judged, in any row: one work cycle, in which a loader takes up, carries and dumps a load and drives the same
# ground both ways, which is what calibration needs. Runs that are shorter than 600 s settle for the same share of them.
SETTLE_S, SETTLE_SHARE = 240.0, 0.4
CHUNK = 5000  # readings that the pipeline gets at a time
SOURCES = ("agents", "protocol")  # what samples depend on, beside their recording
# Of `kalman`, `calibrated`: the goals of the issue. A bias counts by its size.
GOALS = (
    ("right_class_pct", ">=", 96.0),
    ("wrong_cells_pct", "<=", 3.5),
    ("wrong_cells_interior_pct", "<=", 1.0),
    ("dirt_flat_right_pct", ">=", 97.0),
    ("grade_bias_deg", "<=", 0.1),
    ("grade_std_deg", "<=", 0.35),
    ("wrong_slope_cells_pct", "<=", 0.2),
)
DIGITS = 3


@dataclass(frozen=True)
class Row:
    """One row of the table."""

    estimator: str
    preset: str

    @property
    def name(self) -> str:
        """Short and unique."""
        return f"{self.estimator}-{self.preset}"

    @property
    def options(self) -> PipelineConfig:
        """The agent's."""
        return options(self.estimator, calibrate=PRESETS[self.preset][1])


ROWS = tuple(Row(estimator, preset) for estimator in ESTIMATORS for preset in PRESETS)
GOAL_ROW = Row("kalman", "calibrated")


@dataclass(frozen=True)
class Plan:
    """What to run. cache: folder of recordings and samples. processes: how many at a time."""

    seeds: tuple[int, ...]
    seconds: float
    cache: Path
    processes: int
    rows: tuple[Row, ...] = ROWS
    setup: Setup = LOADING

    def task(self, seed: int, row: Row) -> Task:
        """One row on one recording."""
        return Task(Drive(seed, self.seconds, PRESETS[row.preset][0], self.setup), row, self.cache)


@dataclass(frozen=True)
class Task:
    """One row on one recording."""

    drive: Drive
    row: Row
    cache: Path

    @property
    def folder(self) -> Path:
        """Of the recording."""
        return self.drive.folder(self.cache)


@dataclass(frozen=True)
class Run:
    """What the pipeline made of a recording: samples, what it withheld by reason, and its processor time."""

    samples: Table
    withheld: dict[str, int]
    us_per_second: float


@dataclass(frozen=True)
class Outcome:
    """One row on one recording, with the truth, and judged from an instant on."""

    task: Task
    run: Run
    way: Way
    ground: Ground
    from_ns: int
    judged: Judged


def options(estimator: str, *, calibrate: bool) -> PipelineConfig:
    """The agent's options of a row."""
    return PipelineConfig(estimation=EstimationConfig(estimator=estimator, calibrate=calibrate))


def run(plan: Plan, on_progress: Progress = lambda *_: None) -> tuple[dict[str, Any], list[Outcome]]:
    """Record, estimate and judge everything of a plan; returns the report in plain values, and the outcomes.

    The report has `rows`, one per estimator and preset, and `goals`.
    """
    outcomes = _outcomes(plan, on_progress)
    rows = [summarise(row, [o for o in outcomes if o.task.row == row]) for row in plan.rows]
    report = {
        "scenario": plan.setup.scenario,
        "routes": list(plan.setup.routes),
        "seeds": list(plan.seeds),
        "seconds": plan.seconds,
        "judged_from_s": settle_s(plan.seconds),
        "rows": rows,
        "goals": [goal for row in rows if Row(row["estimator"], row["preset"]) == GOAL_ROW for goal in goals(row)],
    }
    return report, outcomes


def settle_s(seconds: float) -> float:
    """How much of a run's beginning is not judged."""
    return min(SETTLE_S, SETTLE_SHARE * seconds)


def summarise(row: Row, outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """One row: figures of all samples and cells together, with intervals over seeds where they are wanted."""
    each_seed = [figures(outcome.judged) for outcome in outcomes]
    judged = pool([outcome.judged for outcome in outcomes])
    runs = [outcome.run for outcome in outcomes]
    found = figures(judged)
    for name in ("right_class", "wrong_cells"):
        found[f"{name}_ci95"] = half_width(_finite([seed[f"{name}_pct"] for seed in each_seed]))
    reasons = sorted({reason for one in runs for reason in one.withheld})
    return {
        "estimator": row.estimator,
        "preset": row.preset,
        **{name: _round(value) for name, value in found.items()},
        "samples": sum(len(one.samples) for one in runs),
        "us_per_second": round(sum(one.us_per_second for one in runs) / len(runs)),
        "soils": [{name: _round(value) for name, value in soil.items()} for soil in soils(judged)],
        "by_border": [{name: _round(value) for name, value in part.items()} for part in by_border(judged)],
        "c_rr_bias_by_seed": [round(c_rr_bias(outcome.judged), 5) for outcome in outcomes],
        "wrong_cells_by_seed_pct": [_round(seed["wrong_cells_pct"]) for seed in each_seed],
        "withheld": {reason: sum(one.withheld.get(reason, 0) for one in runs) for reason in reasons},
    }


def goals(row: dict[str, Any]) -> list[dict[str, Any]]:
    """What the issue wants of a row, and whether it is so; what is not known is not met."""
    listed = []
    for name, relation, limit in GOALS:
        found = row[name]
        met = abs(found) <= limit if relation == "<=" else found >= limit
        label = f"{row['estimator']} {row['preset']}"
        listed.append({"row": label, "name": name, "goal": f"{relation} {limit:g}", "found": found, "met": bool(met)})
    return listed


def _finite(numbers: Sequence[float]) -> Floats:
    found: Floats = np.array([number for number in numbers if math.isfinite(number)], float)
    return found


def _round(value: Any) -> Any:
    return rounded(value, DIGITS) if isinstance(value, float) else value


# --- recordings and runs, kept ---------------------------------------------------------------------------------------


def _outcomes(plan: Plan, on_progress: Progress) -> list[Outcome]:
    """Outcomes of all tasks by seeds and rows, from the cache where they are there."""
    tasks = [plan.task(seed, row) for seed in plan.seeds for row in plan.rows]
    tasks.sort(key=lambda task: (task.drive.seed, task.drive.preset))  # a worker loads each recording once
    carry_out(tasks, run_file, _estimate, plan.processes, on_progress)
    return [judge_task(task) for task in tasks]


def run_file(task: Task) -> Path:
    """Where the samples of a task are kept."""
    key = digest(repr(task.row.options), repr(task.drive.machine), code_version(*SOURCES))
    return task.folder / "ground" / f"{task.row.name}-{key}.npz"


def read_run(path: Path) -> Run:
    """Read what a worker wrote."""
    with np.load(path) as kept:
        return Run(kept["samples"], json.loads(str(kept["withheld"])), float(kept["us_per_second"]))


def judge_task(task: Task) -> Outcome:
    """Compare what a worker kept with the truth."""
    found = read_run(run_file(task))
    way, ground = _truth(task.drive, task.cache)
    from_ns = int(way.stamp_ns[0]) + round(settle_s(task.drive.seconds) * 1e9)
    judged = judge(found.samples, way, ground, LAG_S, from_ns)
    return Outcome(task, found, way, ground, from_ns, judged)


@lru_cache(maxsize=2)  # tasks come recording by recording
def _truth(drive: Drive, cache: Path) -> tuple[Way, Ground]:
    way = read_way(track_file(drive.folder(cache)), drive.machine.load_centre_m)
    return way, lay_ground(drive.scenario.ground, drive.seed)


# --- in the worker processes -----------------------------------------------------------------------------------------


def _estimate(job: tuple[Task, Path]) -> None:
    """Run one row on one recording, and keep its samples, whole or not at all."""
    task, file = job
    check_name(file, run_file(task))
    recording = loaded(task.drive, task.cache)
    pipeline = Pipeline(recording.site, recording.machine, task.row.options)
    samples, cpu_s = sample(pipeline, recording)
    seconds = (recording.readings[-1].stamp_ns - recording.readings[0].stamp_ns) * 1e-9
    kept: dict[str, Any] = {
        "samples": samples,
        "withheld": json.dumps(pipeline.health()["withheld"]),
        "us_per_second": cpu_s * 1e6 / seconds if seconds else math.nan,
    }
    file.parent.mkdir(exist_ok=True)
    part = file.with_name(f"{file.stem}.part.npz")
    np.savez_compressed(part, **kept)
    part.rename(file)


def sample(pipeline: Pipeline, recording: Recording) -> tuple[Table, float]:
    """All samples that a pipeline makes of a recording, and the processor time [s] that it took."""
    began_s = time.process_time()
    readings = recording.readings
    made = [pipeline.step(readings[i : i + CHUNK]) for i in range(0, len(readings), CHUNK)]
    return np.concatenate(made), time.process_time() - began_s
