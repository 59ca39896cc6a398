"""The paper's table: every configuration on the same recordings of the paper's site, against the truth.

Poses are all it compares, so only the localising half of the pipeline runs, without ground estimation and sampling;
`us_per_second` is what localisation costs, which is the paper's argument for cheap sensors on a small computer.
Smoothed poses, which samples get, are judged at their own stamps; those within the lag are as known when the drive
ends.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from agents.positioning import PipelineConfig, Positioning
from lab.campaign.experiment import Experiment, Runner, Task, replay_task
from lab.campaign.recordings import MACHINES_PROTOCOL, PAPER, PlannedDrive, RecordedDrive, Setup
from lab.positions.configurations import Configuration
from lab.positions.substitution import gps_errors, true_motion, with_gps_errors
from protocol.arrays import Floats
from protocol.machine.machine_config import MachineConfig
from protocol.machine.readings import Reading
from sim.sensors.presets import GpsNoise
from sitegrid.logs.replay import Score, errors, replay, score
from sitegrid.logs.sensors import UnsupportedError, select
from sitegrid.proof.figures import Report, Row, half_width, rounded

TRACE_S = 1.0  # between two points of the curves that plots draw
SOURCES = (
    "agents",
    *MACHINES_PROTOCOL,
    *(f"lab/positions/{part}.py" for part in ("table", "configurations", "replay", "consistency", "substitution")),
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


def run(
    runner: Runner, seeds: Sequence[int], seconds: float, rows: Sequence[Configuration], setup: Setup = PAPER
) -> tuple[Report, list[Outcome]]:
    """Record, replay and score all configurations with all seeds; `missing`: those that the pipeline cannot run."""
    drives = [PlannedDrive(seed, seconds, setup.preset, setup) for seed in seeds]
    machine = drives[0].machine
    rows = [as_recorded(row, drives[0]) for row in rows]
    refusals = {row: _why_not(machine, row) for row in rows}
    runnable = [row for row, why in refusals.items() if not why]
    pairs = [(drive, row) for drive in drives for row in runnable]
    runs = runner.run(EXPERIMENT, [replay_task(row, drive) for drive, row in pairs])
    outcomes = [Outcome(*pair, run) for pair, run in zip(pairs, runs, strict=True)]
    scores = {row: [o.run for o in outcomes if o.row == row] for row in runnable}
    report: Report = {
        "scenario": setup.scenario,
        "gps_error": gps_error(drives[0]),
        "seeds": list(seeds),
        "seconds": seconds,
        "rows": [summarise(row, several) for row, several in scores.items()],
        "ratios": ratios(scores),
        "missing": [{**vars(row), "why": why} for row, why in refusals.items() if why],
    }
    return report, outcomes


def as_recorded(row: Configuration, drive: PlannedDrive) -> Configuration:
    """A row with the share of slow GPS errors of a recording, where it names none."""
    return row if row.machine_share is not None else replace(row, machine_share=_gps(drive).machine_share)


def gps_error(drive: PlannedDrive) -> Row:
    """How slow the GPS errors of a drive are: on white noise every filter looks wonderful."""
    gps = _gps(drive)
    slow, white = gps.drift_std_m**2, gps.white_std_m**2
    return {
        "preset": drive.preset,
        "rms_2d_m": round((2 * (slow + white)) ** 0.5 * gps.scale, 3),
        "slow_variance_share": round(slow / (slow + white), 3),
        "correlation_time_s": gps.drift_time_s,
        **{n: getattr(gps, n) for n in ("rate_hz", "machine_share", "site_share", "outage_s", "outage_period_s")},
    }


def _gps(drive: PlannedDrive) -> GpsNoise:
    return drive.scenario.preset(drive.preset).gps


def _why_not(machine: MachineConfig, row: Configuration) -> str:
    """Why the pipeline cannot run a row; nothing if it can."""
    try:
        select(machine, row.gps, row.imu)
    except UnsupportedError as error:
        return str(error)
    return ""


# --- rows ------------------------------------------------------------------------------------------------------------


def summarise(row: Configuration, scores: Sequence[Score]) -> Row:
    """One row of the table: means over the seeds; beside their net error, the paper's."""
    net, paper = values(scores, "net_m"), row.published_net_m

    def mean(name: str) -> float:
        return float(values(scores, name).mean())

    summary = {
        **vars(row),
        "rmse_x_m": mean("rmse_x_m"),
        "rmse_y_m": mean("rmse_y_m"),
        "net_m": mean("net_m"),
        "ci95_m": half_width(net),
        "max_m": float(values(scores, "max_m").max()),
        "nees": mean("nees"),
        "nees_95": nees_interval(scores),
        "coverage95": mean("coverage95"),
        "covered": mean("covered"),
        "smoothed_net_m": mean("smoothed_net_m"),
        "smoothed_nees": mean("smoothed_nees"),
        "smoothed_coverage95": mean("smoothed_coverage95"),
        "us_per_second": round(mean("us_per_second")),
        "paper_net_m": paper,
        "difference_m": None if paper is None else mean("net_m") - paper,
        "net_by_seed_m": net.tolist(),
    }
    return rounded(summary, 4, max_m=3, nees=3, nees_95=3, smoothed_nees=3)


def ratios(scores: Mapping[Configuration, Sequence[Score]]) -> list[Row]:
    """Net errors over others on the same drives: of profiles, filters, receivers, smoothed over live."""
    rows = []
    for row in scores:
        net, smoothed = values(scores[row], "net_m"), values(scores[row], "smoothed_net_m")
        others = {
            "default/paper": replace(row, profile="paper"),
            "ekf/ukf": replace(row, filter="ukf"),
            "one more receiver": replace(row, gps=max(row.gps - 1, 1)),
        }
        pairs = {
            name: (net, values(scores[other], "net_m"))
            for name, other in others.items()
            if other != row and other in scores
        }
        if np.isfinite(smoothed).all():
            pairs["smoothed/live"] = smoothed, net
        for name, pair in pairs.items():
            ratio, half = paired_ratio(*pair)
            rows.append(rounded({**vars(row), "ratio": name, "net": ratio, "ci95": half}, 4))
    return rows


def paired_ratio(a: Floats, b: Floats) -> tuple[float, float | None]:
    """Ratio of the means of paired values (n,), and the half-width of its 95 % interval (None of one pair)."""
    ratio = float(a.mean() / b.mean())
    return ratio, half_width((a - ratio * b) / b.mean())


def nees_interval(scores: Sequence[Score]) -> list[float]:
    """Interval of the mean NEES over independent runs: the half-widths of their intervals add as squares."""
    low, high = values(scores, "nees_low"), values(scores, "nees_high")
    middle, half = (low + high) / 2, (high - low) / 2
    width = float(np.sqrt((half**2).sum())) / len(scores)
    return [float(middle.mean()) - width, float(middle.mean()) + width]


def values(scores: Sequence[Score], name: str) -> Floats:
    """One field of scores (n,)."""
    return np.array([getattr(score, name) for score in scores], float)


# --- in the worker processes -----------------------------------------------------------------------------------------


def _replay(task: Task[Configuration], cache: Path) -> ScoredRun:
    """Run one configuration on one recording."""
    recording, machine, options, readings = prepared(task, cache)
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


def prepared(
    task: Task[Configuration], cache: Path
) -> tuple[RecordedDrive, MachineConfig, PipelineConfig, list[Reading]]:
    """Recording, machine, options and readings of one configuration on one recording."""
    recording = _with_share(task, cache)
    machine, options = select(recording.machine, task.variant.gps, task.variant.imu), task.variant.options
    if not task.variant.gps:
        options = replace(options, localisation=replace(options.localisation, start=recording.start))
    in_use = {sensor.name for sensor in machine.sensors if sensor.use}
    return recording, machine, options, [reading for reading in recording.readings if reading.sensor in in_use]


def _with_share(task: Task[Configuration], cache: Path) -> RecordedDrive:
    """The recording of a task, its fixes made anew where receivers share something else than they did.

    The seed of the errors is that of the drive: with the share that was recorded, they would be the recorded ones.
    """
    recording, drive, share = task.recording(cache), task.drive, task.variant.machine_share
    assert drive
    gps = _gps(drive)
    if share is None or share == gps.machine_share:
        return recording
    motion = true_motion(drive.folder(cache))
    noise = replace(gps, machine_share=share, site_share=min(gps.site_share, share))
    return with_gps_errors(
        recording, motion, gps_errors(recording.machine, noise, drive.seed, int(motion.stamp_ns[-1]))
    )


EXPERIMENT = Experiment("localisation", ScoredRun, SOURCES, _replay)
