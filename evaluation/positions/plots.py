"""Pictures of the table: net errors beside the paper's, error over time, tracks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from evaluation.campaign.experiment import Runner
from evaluation.campaign.pictures import WIDTH_IN, draw_all
from evaluation.campaign.recordings import PlannedDrive, track_file
from evaluation.campaign.truth import Truth, read_track
from evaluation.positions.configurations import Configuration
from evaluation.positions.summary import TableRow
from evaluation.positions.table import TRACE_S, Outcome, TableReport
from protocol.arrays import Floats

ELLIPSE_EVERY_S = 30.0
RADIUS_95 = 2.448  # of the 95 % circle, in standard deviations of one axis
# Colours that also colour-blind people tell apart (Okabe and Ito), by filter and profile; dashes are the EKF.
COLOUR = {"default": "#0072B2", "paper": "#D55E00"}
DASHES = {"ukf": "-", "ekf": "--"}


def draw(report: TableReport, outcomes: Sequence[Outcome], runner: Runner, folder: Path) -> list[Path]:
    """Draw all pictures of a report into a folder; returns their paths."""
    outcomes = [outcome for outcome in outcomes if len(outcome.run.time_s)]
    if not outcomes:
        return []
    pictures = {"table": partial(draw_table, report), "errors": partial(draw_errors, report, outcomes)}
    for drive in list(dict.fromkeys(o.drive for o in outcomes))[:3]:  # one of each tour
        shown = [o for o in outcomes if o.drive == drive]
        pictures[f"tracks_seed{drive.seed}"] = partial(draw_tracks, drive, runner.cache, shown)
    return draw_all(pictures, folder)


def draw_table(report: TableReport) -> Figure:
    """Net errors of all rows with their intervals, and the paper's figures as crosses."""
    rows = [row for row in report.rows if math.isfinite(row.net_m)]
    groups = list(dict.fromkeys(row.sensors for row in rows))
    kinds = list(dict.fromkeys((row.filter, row.profile) for row in rows))
    figure, axes = plt.subplots(figsize=(WIDTH_IN, 4.2), constrained_layout=True)
    wide = 0.8 / len(kinds)
    for row in rows:
        filter_, profile = row.filter, row.profile
        x = groups.index(row.sensors) + (kinds.index((filter_, profile)) - (len(kinds) - 1) / 2) * wide
        hatch = "//" if filter_ == "ekf" else ""
        axes.bar(x, row.net_m, wide * 0.92, color=COLOUR[profile], hatch=hatch, edgecolor="white")
        axes.errorbar(x, row.net_m, row.ci95_m or 0.0, color="black", capsize=2, lw=1)
        if row.paper_net_m is not None:
            axes.plot(x, row.paper_net_m, "x", color="black", ms=7)
    axes.set_xticks(range(len(groups)), [_sensors(gps, imu) for gps, imu in groups])
    axes.set_ylabel("net RMSE [m]")
    axes.grid(visible=False, axis="x")
    _limit_height(axes, rows, groups)
    for filter_, profile in kinds:
        hatch = "//" if filter_ == "ekf" else ""
        axes.bar(0, 0, color=COLOUR[profile], hatch=hatch, edgecolor="white", label=_kind(filter_, profile))
    axes.plot([], [], "x", color="black", ms=7, label="the paper")
    axes.legend(ncols=len(kinds) + 1)
    axes.set_title(_title(report), loc="left")
    return figure


def _limit_height(axes: Axes, rows: Sequence[TableRow], groups: Sequence[tuple[int, int]]) -> None:
    """Without GPS errors are tens of metres: such bars leave the picture, and the figures stand beside them."""
    highest = max((max(r.net_m + (r.ci95_m or 0), r.paper_net_m or 0) for r in rows if r.gps), default=0)
    if highest:
        axes.set_ylim(0, 1.2 * highest)
        for row in rows:
            if row.gps == 0 and row.net_m > highest:
                axes.text(
                    groups.index((0, row.imu)), 1.1 * highest, "off the scale", ha="center", fontsize=8,
                    bbox={"facecolor": "white", "edgecolor": "none"},
                )  # fmt: skip
                break


def draw_errors(report: TableReport, outcomes: Sequence[Outcome]) -> Figure:
    """Distance from the truth over time, rms over the seeds; bands show what the default UKF believed of itself."""
    groups = _groups(outcomes)
    figure, panels = plt.subplots(
        len(groups), figsize=(WIDTH_IN, 2.1 * len(groups) + 0.6), sharex=True, squeeze=False, constrained_layout=True
    )
    for axes, group in zip(panels[:, 0], groups, strict=True):
        rows = list(dict.fromkeys(o.row for o in outcomes if o.row.sensors == group))
        for row in rows:
            _draw_error(axes, row, [o for o in outcomes if o.row == row], only=len(rows) == 1)
        axes.set_title(_sensors(*group), loc="left", fontsize=9, weight="bold")
        axes.set_ylabel("error [m]")
        axes.set_ylim(bottom=0)
        axes.margins(x=0.01)
    panels[0, 0].legend(ncols=6, loc="upper right")
    panels[-1, 0].set_xlabel("time [s]")
    figure.suptitle(f"Root mean square over the seeds. {_title(report)}", x=0.01, ha="left", fontsize=9)
    return figure


def _draw_error(axes: Axes, row: Configuration, outcomes: Sequence[Outcome], *, only: bool) -> None:
    time, distance, radius = _over_seeds(outcomes)
    colour = COLOUR[row.profile]
    if row.filter == "ukf" and (row.profile == "default" or only):
        axes.fill_between(time, 0, radius, color=colour, alpha=0.12, lw=0, label="95 % radius that the UKF states")
    if only:
        for outcome in outcomes:
            error = np.hypot(*outcome.run.error_m.T)
            axes.plot(outcome.run.time_s, error, color="grey", lw=0.5, alpha=0.6)
    axes.plot(time, distance, DASHES[row.filter], color=colour, lw=1.2, label=_kind(row.filter, row.profile))


def _over_seeds(outcomes: Sequence[Outcome]) -> tuple[Floats, Floats, Floats]:
    """Time (n,), rms distance (n,) over the seeds, and mean 95 % radius (n,)."""
    count = 1 + max(int(o.run.time_s[-1] // TRACE_S) for o in outcomes)
    squares, radii = np.full((2, len(outcomes), count), np.nan)
    for i, outcome in enumerate(outcomes):
        at = (outcome.run.time_s // TRACE_S).astype(int)
        squares[i, at] = (outcome.run.error_m**2).sum(axis=1)
        radii[i, at] = RADIUS_95 * outcome.run.std_m
    seen = np.isfinite(squares).any(axis=0)
    distance = np.asarray(np.sqrt(np.nanmean(squares[:, seen], axis=0)), np.float64)
    time = np.asarray(np.flatnonzero(seen) * TRACE_S, np.float64)
    return time, distance, np.asarray(np.nanmean(radii[:, seen], axis=0), np.float64)


def draw_tracks(drive: PlannedDrive, cache: Path, outcomes: Sequence[Outcome]) -> Figure:
    """Truth and estimates of one recording from above, one panel per set of sensors."""
    truth = read_track(track_file(drive.folder(cache)))
    groups = _groups(outcomes)
    columns = min(3, len(groups))
    lines = -(-len(groups) // columns)
    figure, panels = plt.subplots(
        lines, columns, figsize=(WIDTH_IN, 3.6 * lines + 0.5), squeeze=False, sharex=True, sharey=True,
        constrained_layout=True,
    )  # fmt: skip
    for axes in panels.flat[len(groups) :]:
        axes.set_visible(False)
    for axes, group in zip(panels.flat, groups, strict=False):
        _draw_truth(axes, truth)
        for outcome in outcomes:
            if outcome.row.sensors == group:
                _draw_track(axes, outcome)
        axes.set_title(_sensors(*group), loc="left", fontsize=9, weight="bold")
        axes.set_aspect("equal")
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=5)
    for axes in panels[-1]:
        axes.set_xlabel("east [m]", fontsize=9)
    figure.supylabel("north [m]", fontsize=9)
    title = f"Seed {drive.seed}, tour {drive.tour}, the last lap; circles: 95 % radius that the default UKF states"
    figure.suptitle(title, x=0.01, ha="left", fontsize=9)
    return figure


def _draw_truth(axes: Axes, truth: Truth) -> None:
    x, y = truth.position_m.T
    axes.plot(x, y, color="black", lw=3.5, alpha=0.18, label="truth")
    room = 8.0
    axes.set_xlim(x.min() - room, x.max() + room)
    axes.set_ylim(y.min() - room, y.max() + room)


def _draw_track(axes: Axes, outcome: Outcome) -> None:
    """The last lap alone: twenty laps over each other show nothing."""
    run, row = outcome.run, outcome.row
    last = run.time_s >= run.time_s[-1] - _lap_s(run.position_m)
    x, y = run.position_m[last].T
    axes.plot(x, y, DASHES[row.filter], color=COLOUR[row.profile], lw=1.1, label=_kind(row.filter, row.profile))
    if (row.filter, row.profile) == ("ukf", "default"):
        every = max(1, round(ELLIPSE_EVERY_S / TRACE_S / 3))
        for place, std in zip(run.position_m[last][::every], run.std_m[last][::every], strict=True):
            axes.add_patch(Circle(tuple(place), RADIUS_95 * std, fill=False, color=COLOUR[row.profile], lw=0.5))


def _lap_s(position_m: Floats) -> float:
    """Duration of the last lap: since the machine was last near to where it is now, after having been away."""
    away = np.hypot(*(position_m - position_m[-1]).T)
    far = np.flatnonzero(away > 30.0)
    if not len(far):
        return len(away) * TRACE_S
    near = np.flatnonzero(away[: far[-1]] < 8.0)
    return float(len(away) - (near[-1] if len(near) else 0)) * TRACE_S


def _groups(outcomes: Sequence[Outcome]) -> list[tuple[int, int]]:
    return list(dict.fromkeys(o.row.sensors for o in outcomes))


def _sensors(gps: int, imu: int) -> str:
    return f"{gps} GPS, {imu} IMU"


def _kind(filter_: str, profile: str) -> str:
    return f"{filter_.upper()} {profile}"


def _title(report: TableReport) -> str:
    error = report.gps_error
    return (
        f"{len(report.seeds)} seeds of {report.seconds:g} s; GPS {error['rms_2d_m']:g} m, "
        f"{100 * error['slow_variance_share']:.0f} % of its variance slow (tau {error['correlation_time_s']:g} s)"
    )
