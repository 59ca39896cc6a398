"""Accuracy of rolling resistance and gradient: working loaders, all rows on the same recordings.

Pipeline samples are cached; the comparison with the truth is quick and always repeated.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from agents.estimation.ground import EstimationConfig
from agents.estimation.tuning import TUNING, EstimationTuning
from agents.pipeline import Pipeline
from agents.positioning import PipelineConfig
from agents.sampling import LAG_S
from lab.campaign.experiment import Experiment, Runner, Task, replay_task
from lab.campaign.figures import judge
from lab.campaign.goals import goals
from lab.campaign.recordings import PlannedDrive, Setup, track_file
from lab.ground.comparison import Comparison, compare, pool
from lab.ground.figures import by_border, c_rr_bias, figures, soils
from lab.ground.truth import TrueGround, true_ground
from protocol.arrays import Table
from sitegrid.proof.figures import Report, Row, half_width, rounded
from sitegrid.proof.tracks import LoadTrack, read_load_track

LOADING = Setup("loading", ("west", "east", "middle", "yard"), gps=(1, 2), imu=(3,))
ESTIMATORS = ("kalman", "rls")
# Row's preset -> simulator preset, and whether the machine calibrates itself by its work.
PRESETS = {"nominal": ("dgps", False), "calibrated": ("dgps", True), "harsh": ("harsh", True)}
# Not judged: one work cycle (load, carry, dump, same ground both ways), which calibration needs. Runs under 600 s skip
# the same share.
SETTLE_S, SETTLE_SHARE = 240.0, 0.4
CHUNK = 5000  # readings per pipeline step
DIGITS = 3


@dataclass(frozen=True)
class GroundConfiguration:
    """A row's configuration."""

    estimator: str
    preset: str

    @property
    def name(self) -> str:
        """Short unique name."""
        return f"{self.estimator}-{self.preset}"

    @property
    def options(self) -> PipelineConfig:
        """The agent's options."""
        calibrate = PRESETS[self.preset][1]
        return PipelineConfig(estimation=EstimationConfig(estimator=self.estimator, calibrate=calibrate))

    @property
    def tuning(self) -> EstimationTuning:
        """Estimator tuning."""
        return TUNING


ROWS = tuple(GroundConfiguration(estimator, preset) for estimator in ESTIMATORS for preset in PRESETS)
GOALS = goals("ground")


@dataclass(frozen=True)
class PipelineOutput:
    """A recording's samples, withheld ones by reason, and CPU time."""

    samples: Table
    withheld: dict[str, int]
    us_per_second: float


@dataclass(frozen=True)
class GroundOutcome:
    """One row on one recording: output and comparison with the truth."""

    row: GroundConfiguration
    output: PipelineOutput
    comparison: Comparison


def run(
    runner: Runner,
    seeds: Sequence[int],
    seconds: float,
    rows: Sequence[GroundConfiguration] = ROWS,
    setup: Setup = LOADING,
) -> tuple[Report, list[GroundOutcome]]:
    """Record, estimate and judge all rows and seeds; a row per estimator and preset, and the goals."""
    pairs = [(PlannedDrive(seed, seconds, PRESETS[row.preset][0], setup), row) for seed in seeds for row in rows]
    pairs.sort(key=lambda pair: (pair[0].seed, pair[0].preset))  # each worker loads a recording once
    outputs = runner.run(EXPERIMENT, [replay_task(row, drive) for drive, row in pairs])
    outcomes = [judged(*pair, output, runner.cache) for pair, output in zip(pairs, outputs, strict=True)]
    table = [summarise(row, [outcome for outcome in outcomes if outcome.row == row]) for row in rows]
    drives = {"scenario": setup.scenario, "routes": list(setup.routes), "seeds": list(seeds), "seconds": seconds}
    judged_from_s = settle_s(seconds)
    return {**drives, "judged_from_s": judged_from_s, "rows": table, "goals": judge(GOALS, table)}, outcomes


def settle_s(seconds: float) -> float:
    """Unjudged start of a run."""
    return min(SETTLE_S, SETTLE_SHARE * seconds)


def judged(drive: PlannedDrive, row: GroundConfiguration, output: PipelineOutput, cache: Path) -> GroundOutcome:
    """Compare one row's samples on one recording with the truth."""
    track, ground = _truth(drive, cache)
    from_ns = int(track.stamp_ns[0]) + round(settle_s(drive.seconds) * 1e9)
    return GroundOutcome(row, output, compare(output.samples, track, ground, LAG_S, from_ns))


@lru_cache(maxsize=2)  # tasks are grouped by recording
def _truth(drive: PlannedDrive, cache: Path) -> tuple[LoadTrack, TrueGround]:
    track = read_load_track(track_file(drive.folder(cache)), drive.machine.load_centre_m)
    return track, true_ground(drive.scenario.ground, drive.seed)


def summarise(row: GroundConfiguration, outcomes: Sequence[GroundOutcome]) -> Row:
    """A table row: pooled figures with intervals over seeds."""
    by_seed = [figures(outcome.comparison) for outcome in outcomes]
    wrong_by_seed = [seed["wrong_cells_pct"] for seed in by_seed]
    pooled: Comparison = pool([outcome.comparison for outcome in outcomes])
    outputs = [outcome.output for outcome in outcomes]
    withheld: Counter[str] = Counter()
    for output in outputs:
        withheld.update(output.withheld)
    summary = {
        **vars(row),
        **figures(pooled),
        "right_class_ci95": _interval([seed["right_class_pct"] for seed in by_seed]),
        "wrong_cells_ci95": _interval(wrong_by_seed),
        "samples": sum(len(output.samples) for output in outputs),
        "us_per_second": round(sum(output.us_per_second for output in outputs) / len(outputs)),
        "soils": soils(pooled.cells),
        "by_border": by_border(pooled.cells),
        "c_rr_bias_by_seed": [c_rr_bias(outcome.comparison.placed) for outcome in outcomes],
        "wrong_cells_by_seed_pct": wrong_by_seed,
        "withheld": dict(sorted(withheld.items())),
    }
    return rounded(summary, DIGITS, c_rr_bias_by_seed=5)


def _interval(numbers: Sequence[float]) -> float | None:
    """Half-width of the interval over seeds that have the figure."""
    return half_width(np.array([number for number in numbers if math.isfinite(number)]))


# --- in the worker processes -----------------------------------------------------------------------------------------


def _estimate(task: Task[GroundConfiguration], cache: Path) -> PipelineOutput:
    recording = task.recording(cache)
    what, readings = task.variant, recording.readings
    pipeline = Pipeline(recording.site, recording.machine, what.options, tuning=what.tuning)
    began_s = time.process_time()
    made = [pipeline.step(readings[i : i + CHUNK]).final for i in range(0, len(readings), CHUNK)]
    samples = np.concatenate([*made, pipeline.finish().final])
    cpu_s = time.process_time() - began_s
    seconds = (readings[-1].stamp_ns - readings[0].stamp_ns) * 1e-9
    return PipelineOutput(samples, pipeline.health()["withheld"], cpu_s * 1e6 / seconds if seconds else math.nan)


EXPERIMENT = Experiment("ground", PipelineOutput, _estimate)
