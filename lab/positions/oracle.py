"""The oracle: how far the smoother is from the batch optimum of the same run, as far as the truth can tell.

The EKF runs with a lag beyond the run and every step of it is noted, then GTSAM finds the optimum over these steps
(`batch_optimum`); both, and the smoother with its usual lag, are judged at the same stamps, once a second.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path

import numpy as np

from agents.localisation.localiser import MAX_LAG_S
from agents.positioning import Positioning
from lab.campaign.experiment import Experiment, Runner, Task, replay_task
from lab.positions.batch_optimum import optimum
from lab.positions.configurations import Configuration
from lab.positions.filter_steps import StepRecorder
from lab.positions.table import SOURCES, Outcome, paired_ratio, prepared
from protocol.arrays import Floats
from sitegrid.logs.replay import Track, errors, replay
from sitegrid.proof.figures import Row, root_mean_square, rounded


@dataclass(frozen=True)
class OracleRun:
    """Net errors of one run [m]: of the optimum, smoothed with a lag beyond the run, smoothed with the usual lag, live.

    apart_m: root mean square of the distance between the first two.
    """

    optimum_net_m: float
    whole_net_m: float
    smoothed_net_m: float
    live_net_m: float
    apart_m: float


def require() -> None:
    """Fail at once, not after the drives, where GTSAM is not installed; ModuleNotFoundError."""
    import_module("gtsam")


def run(runner: Runner, outcomes: Sequence[Outcome]) -> list[Row]:
    """Judge the EKF of the profile `default` on the recordings of a table's outcomes, a row each."""
    drives = list(dict.fromkeys(outcome.drive for outcome in outcomes))
    rows = [r for r in dict.fromkeys(o.row for o in outcomes) if (r.filter, r.profile) == ("ekf", "default") and r.gps]
    pairs = [(drive, row) for drive in drives for row in rows]
    runs = runner.run(EXPERIMENT, [replay_task(row, drive) for drive, row in pairs])
    return [summarise(row, [done for (_, each), done in zip(pairs, runs, strict=True) if each == row]) for row in rows]


def summarise(row: Configuration, runs: Sequence[OracleRun]) -> Row:
    """One row: means over the seeds, and ratios to the optimum with the half-widths of their 95 % intervals."""
    figures = {name: np.array([getattr(run, name) for run in runs]) for name in vars(runs[0])}
    summary: Row = {**vars(row), **{name: float(values.mean()) for name, values in figures.items()}}
    for name in ("whole", "smoothed", "live"):
        ratio, half = paired_ratio(figures[f"{name}_net_m"], figures["optimum_net_m"])
        summary |= {f"{name}_over_optimum": ratio, f"{name}_ci95": half}
    return rounded(summary, 4)


# --- in the worker processes -----------------------------------------------------------------------------------------


def _judge(task: Task[Configuration], cache: Path) -> OracleRun:
    recording, machine, options, readings = prepared(task, cache)
    beyond = replace(options, localisation=replace(options.localisation, lag_s=MAX_LAG_S))
    positioning = Positioning(recording.site, machine, beyond)
    recorder = positioning.localiser.engine = StepRecorder(positioning.localiser.engine)
    whole = replay(positioning, readings).smoothed
    belief = positioning.localiser.belief
    assert belief
    best = optimum(recorder.steps(belief))
    trace = replay(Positioning(recording.site, machine, options), readings)
    at_best = replace(whole, position_m=np.array([best[stamp][:2] for stamp in whole.stamp_ns.tolist()]))

    def net_m(track: Track) -> float:
        return _rms(errors(track, recording.truth))

    apart_m = _rms(whole.position_m - at_best.position_m)
    return OracleRun(net_m(at_best), net_m(whole), net_m(trace.smoothed), net_m(trace), apart_m)


def _rms(off_m: Floats) -> float:
    """Root mean square distance of vectors (n, 2), of those that are known."""
    return root_mean_square(np.hypot(*off_m[np.isfinite(off_m).all(axis=1)].T))


PARTS = ("oracle", "batch_optimum", "filter_steps")
EXPERIMENT = Experiment("oracle", OracleRun, (*SOURCES, *(f"lab/positions/{part}.py" for part in PARTS)), _judge)
