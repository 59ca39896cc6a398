"""The paper's table: all configurations on the same recordings, against the truth.

Only localisation runs, because only poses are compared; `us_per_second` is its CPU cost, the paper's argument for cheap
sensors on a small computer. Smoothed poses, used for samples, are judged at their own stamps; those within the lag are
as known at the end.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from agents.positioning import Positioning
from lab.campaign.experiment import Experiment, Runner, Task, replay_task
from lab.campaign.recordings import PAPER, PlannedDrive, RecordedDrive, Setup
from lab.positions.configurations import Configuration
from lab.positions.substitution import gps_errors, true_motion, with_gps_errors
from protocol.arrays import Floats
from protocol.machine.machine_config import MachineConfig
from sim.sensors.presets import GpsNoise
from sitegrid.logs.replay import Score, replay, score
from sitegrid.logs.sensors import UnsupportedError, select
from sitegrid.proof.figures import Report, Row, half_width, rounded

Scores = Mapping[Configuration, Sequence[Score]]  # by row, then drive
MEANS = (
    *("rmse_x_m", "rmse_y_m", "net_m", "nees", "coverage95", "covered"),
    *("smoothed_net_m", "smoothed_nees", "smoothed_coverage95"),
)


def run(
    runner: Runner, seeds: Sequence[int], seconds: float, rows: Sequence[Configuration], setup: Setup = PAPER
) -> tuple[Report, Scores]:
    """Record, replay and score all configurations and seeds; `missing`: unsupported ones."""
    drives = [PlannedDrive(seed, seconds, setup.preset, setup) for seed in seeds]
    rows = [as_recorded(row, drives[0]) for row in rows]
    refusals = {row: _why_not(drives[0].machine, row) for row in rows}
    runnable = [row for row, why in refusals.items() if not why]
    scores = scored(runner, drives, runnable)
    report: Report = {
        "scenario": setup.scenario,
        "gps_error": gps_error(drives[0]),
        "seeds": list(seeds),
        "seconds": seconds,
        "rows": [summarise(row, several) for row, several in scores.items()],
        "ratios": ratios(scores),
        "missing": [{**vars(row), "why": why} for row, why in refusals.items() if why],
    }
    return report, scores


def scored(runner: Runner, drives: Sequence[PlannedDrive], rows: Sequence[Configuration]) -> Scores:
    """Replay and score rows; scores of each row by drive."""
    runs = iter(runner.run(EXPERIMENT, [replay_task(row, drive) for drive in drives for row in rows]))
    by_drive = [{row: next(runs) for row in rows} for _ in drives]
    return {row: [each[row] for each in by_drive] for row in rows}


def as_recorded(row: Configuration, drive: PlannedDrive) -> Configuration:
    """A row with the recording's share of slow GPS errors by default."""
    return row if row.machine_share is not None else replace(row, machine_share=_gps(drive).machine_share)


def gps_error(drive: PlannedDrive) -> Row:
    """How slow a drive's GPS errors are: on white noise every filter looks good."""
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
    """Why the pipeline cannot run a row, or empty."""
    try:
        select(machine, row.gps, row.imu)
    except UnsupportedError as error:
        return str(error)
    return ""


# --- rows ------------------------------------------------------------------------------------------------------------


def summarise(row: Configuration, scores: Sequence[Score]) -> Row:
    """Table row: means over seeds, and the paper's net error."""
    net, paper = values(scores, "net_m"), row.published_net_m
    summary = {
        **vars(row),
        **{name: float(values(scores, name).mean()) for name in MEANS},
        "ci95_m": half_width(net),
        "max_m": float(values(scores, "max_m").max()),
        "nees_95": nees_interval(scores),
        "us_per_second": round(float(values(scores, "us_per_second").mean())),
        "paper_net_m": paper,
        "difference_m": None if paper is None else float(net.mean()) - paper,
        "net_by_seed_m": net.tolist(),
    }
    return rounded(summary, 4, max_m=3, nees=3, nees_95=3, smoothed_nees=3)


def ratios(scores: Scores) -> list[Row]:
    """Net error ratios on the same drives: profiles, filters, receivers, smoothed over live."""
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
    """Ratio of means of paired values (n,), and its 95 % half-width (None for one pair)."""
    ratio = float(a.mean() / b.mean())
    return ratio, half_width((a - ratio * b) / b.mean())


def nees_interval(scores: Sequence[Score]) -> list[float]:
    """Interval of the mean NEES over independent runs; half-widths add in squares."""
    low, high = values(scores, "nees_low"), values(scores, "nees_high")
    middle, half = (low + high) / 2, (high - low) / 2
    width = float(np.sqrt((half**2).sum())) / len(scores)
    return [float(middle.mean()) - width, float(middle.mean()) + width]


def values(scores: Sequence[Score], name: str) -> Floats:
    """One field of scores (n,)."""
    return np.array([getattr(score, name) for score in scores], float)


# --- in the worker processes -----------------------------------------------------------------------------------------


def _replay(task: Task[Configuration], cache: Path) -> Score:
    """Run one configuration on one recording."""
    recording, row = _with_share(task, cache), task.variant
    machine, options = select(recording.machine, row.gps, row.imu), row.options
    if not row.gps:
        options = replace(options, localisation=replace(options.localisation, start=recording.start))
    in_use = {sensor.name for sensor in machine.sensors if sensor.use}
    readings = [reading for reading in recording.readings if reading.sensor in in_use]
    return score(replay(Positioning(recording.site, machine, options, row.tuning), readings), recording.truth)


def _with_share(task: Task[Configuration], cache: Path) -> RecordedDrive:
    """A task's recording, with new fixes if the receivers' share differs.

    Errors are seeded by the drive: the recorded share gives the recorded errors.
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


EXPERIMENT = Experiment("localisation", Score, _replay)
