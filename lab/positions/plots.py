"""Pictures of the table: net errors beside the paper's, error over time, tracks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from lab.campaign import pictures
from lab.campaign.experiment import Runner
from lab.campaign.pictures import EAST, NORTH, head
from lab.campaign.recordings import PlannedDrive, track_file
from lab.positions.configurations import Configuration
from lab.positions.table import TRACE_S, Outcome
from protocol.arrays import Floats
from sitegrid.proof.figures import Report, Row
from sitegrid.proof.tracks import Truth, read_track

ROOM_M = 8.0  # around a track
ELLIPSE_EVERY_S = 30.0
RADIUS_95 = 2.448  # of the 95 % circle, in standard deviations of one axis
Group = tuple[int, int, float | None]  # GPS receivers, IMUs, what the receivers share
COLOUR = {"default": pictures.BLUE, "paper": pictures.VERMILION}
DASHES = {"ukf": "-", "ekf": "--"}


def draw(report: Report, outcomes: Sequence[Outcome], runner: Runner, folder: Path) -> list[Path]:
    """Draw all pictures of a report into a folder; returns their paths."""
    outcomes = [outcome for outcome in outcomes if len(outcome.run.time_s)]
    if not outcomes:
        return []
    drawn = {"table": partial(draw_table, report), "errors": partial(draw_errors, report, outcomes)}
    for drive in list(dict.fromkeys(o.drive for o in outcomes))[:3]:  # one of each tour
        shown = [o for o in outcomes if o.drive == drive]
        drawn[f"tracks_seed{drive.seed}"] = partial(draw_tracks, drive, runner.cache, shown)
    return pictures.draw_all(drawn, folder)


def draw_table(report: Report) -> Figure:
    """Net errors of all rows with their intervals, and the paper's figures as crosses."""
    rows = [row for row in report["rows"] if math.isfinite(row["net_m"])]
    groups = list(dict.fromkeys(map(_group, rows)))
    kinds = list(dict.fromkeys((row["filter"], row["profile"]) for row in rows))
    figure, axes = plt.subplots(figsize=(pictures.WIDTH_IN, 4.2))
    wide = 0.8 / len(kinds)
    for row in rows:
        kind = row["filter"], row["profile"]
        x = groups.index(_group(row)) + (kinds.index(kind) - (len(kinds) - 1) / 2) * wide
        axes.bar(x, row["net_m"], wide * 0.92, **_bar(*kind))
        axes.errorbar(x, row["net_m"], row["ci95_m"] or 0.0, color="black", capsize=2, lw=1)
        if row["paper_net_m"] is not None:
            axes.plot(x, row["paper_net_m"], "x", color="black", ms=7)
    axes.set_xticks(range(len(groups)), [_sensors(*group, "\n") for group in groups])
    axes.set_ylabel("net RMSE [m]")
    axes.grid(visible=False, axis="x")
    _limit_height(axes, rows, groups)
    for kind in kinds:
        axes.bar(0, 0, **_bar(*kind), label=_kind(*kind))
    axes.plot([], [], "x", color="black", ms=7, label="the paper")
    axes.legend(ncols=len(kinds) + 1)
    axes.set_title(_title(report), loc="left")
    return figure


def _bar(filter_: str, profile: str) -> Any:
    return {"color": COLOUR[profile], "hatch": "//" if filter_ == "ekf" else "", "edgecolor": "white"}


def _limit_height(axes: Axes, rows: Sequence[Row], groups: Sequence[Group]) -> None:
    """Without GPS errors are tens of metres: such bars leave the picture, and the figures stand beside them."""
    tops = [max(r["net_m"] + (r["ci95_m"] or 0), r["paper_net_m"] or 0) for r in rows if r["gps"]]
    if highest := max(tops, default=0):
        axes.set_ylim(0, 1.2 * highest)
        white = {"facecolor": "white", "edgecolor": "none"}
        for row in [row for row in rows if row["gps"] == 0 and row["net_m"] > highest][:1]:
            x = groups.index(_group(row))
            axes.text(x, 1.1 * highest, "off the scale", ha="center", fontsize=8, bbox=white)


def draw_errors(report: Report, outcomes: Sequence[Outcome]) -> Figure:
    """Distance from the truth over time, rms over the seeds; bands show what the default UKF believed of itself."""
    groups = _groups(outcomes)
    size = (pictures.WIDTH_IN, 2.1 * len(groups) + 0.6)
    figure, panels = plt.subplots(len(groups), figsize=size, sharex=True, squeeze=False)
    for axes, group in zip(panels[:, 0], groups, strict=True):
        rows = list(dict.fromkeys(o.row for o in outcomes if o.row.sensors == group))
        for row in rows:
            _draw_error(axes, row, [o for o in outcomes if o.row == row], only=len(rows) == 1)
        head(axes, _sensors(*group), 9)
        axes.set_ylabel("error [m]")
        axes.set_ylim(bottom=0)
        axes.margins(x=0.01)
    panels[0, 0].legend(ncols=6, loc="upper right")
    panels[-1, 0].set_xlabel("time [s]")
    head(figure, f"Root mean square over the seeds. {_title(report)}", 9, "normal")
    return figure


def _draw_error(axes: Axes, row: Configuration, outcomes: Sequence[Outcome], *, only: bool) -> None:
    time, distance, radius = _over_seeds(outcomes)
    colour = COLOUR[row.profile]
    if row.filter == "ukf" and (row.profile == "default" or only):
        axes.fill_between(time, 0, radius, color=colour, alpha=0.12, lw=0, label="95 % radius that the UKF states")
    for outcome in outcomes if only else ():
        axes.plot(outcome.run.time_s, np.hypot(*outcome.run.error_m.T), color="grey", lw=0.5, alpha=0.6)
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
    distance, radius = np.sqrt(np.nanmean(squares[:, seen], axis=0)), np.nanmean(radii[:, seen], axis=0)
    return np.asarray(np.flatnonzero(seen) * TRACE_S, np.float64), distance, radius


def draw_tracks(drive: PlannedDrive, cache: Path, outcomes: Sequence[Outcome]) -> Figure:
    """Truth and estimates of one recording from above, one panel per set of sensors."""
    truth = read_track(track_file(drive.folder(cache)))
    groups = _groups(outcomes)
    columns = min(3, len(groups))
    lines = -(-len(groups) // columns)
    size = (pictures.WIDTH_IN, 3.6 * lines + 0.5)
    figure, panels = plt.subplots(lines, columns, figsize=size, squeeze=False, sharex=True, sharey=True)
    for axes in panels.flat[len(groups) :]:
        axes.set_visible(False)
    for axes, group in zip(panels.flat, groups, strict=False):
        _draw_truth(axes, truth)
        for outcome in outcomes:
            if outcome.row.sensors == group:
                _draw_track(axes, outcome)
        head(axes, _sensors(*group), 9)
        axes.set_aspect("equal")
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=5)
    for axes in panels[-1]:
        axes.set_xlabel(EAST, fontsize=9)
    figure.supylabel(NORTH, fontsize=9)
    title = f"Seed {drive.seed}, tour {drive.tour}, the last lap; circles: 95 % radius that the default UKF states"
    head(figure, title, 9, "normal")
    return figure


def _draw_truth(axes: Axes, truth: Truth) -> None:
    x, y = truth.position_m.T
    axes.plot(x, y, color="black", lw=3.5, alpha=0.18, label="truth")
    axes.set(xlim=(x.min() - ROOM_M, x.max() + ROOM_M), ylim=(y.min() - ROOM_M, y.max() + ROOM_M))


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


def _group(row: Row) -> Group:
    return row["gps"], row["imu"], row["machine_share"]


def _groups(outcomes: Sequence[Outcome]) -> list[Group]:
    return list(dict.fromkeys(o.row.sensors for o in outcomes))


def _sensors(gps: int, imu: int, share: float | None, gap: str = ", ") -> str:
    shared = f"{gap}{100 * share:g} % shared" if share else ""
    return f"{gps} GPS, {imu} IMU{shared}"


def _kind(filter_: str, profile: str) -> str:
    return f"{filter_.upper()} {profile}"


def _title(report: Report) -> str:
    error = report["gps_error"]
    return (
        f"{len(report['seeds'])} seeds of {report['seconds']:g} s; GPS {error['rms_2d_m']:g} m, "
        f"{100 * error['slow_variance_share']:.0f} % of its variance slow (tau {error['correlation_time_s']:g} s)"
    )
