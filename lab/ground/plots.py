"""Pictures of the ground's estimate: along the track, over the site, and all rows together."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from lab.campaign import pictures
from lab.campaign.experiment import Runner
from lab.campaign.pictures import EAST, NORTH, ZONE_RGB, head
from lab.ground.comparison import C_RR, CellMeans, Comparison, PlacedSamples, pool, slope_deg
from lab.ground.experiment import GOAL_ROW, ROWS, GroundConfiguration, GroundOutcome
from lab.ground.figures import INTERIOR_M, by_border
from protocol.arrays import AnyArray, Bools, Ints
from protocol.site.ground_classes import ZONES
from sitegrid.proof.figures import Report
from sitegrid.proof.tracks import LoadTrack

PICTURED = ("nominal", "calibrated")  # of GOAL_ROW's estimator, along the track and over the site
SEEDS = 4  # one of each route has pictures of its own
WIDTH_IN = pictures.WIDTH_IN + 2
WINDOW_M = 520.0  # of the track; more is too dense to read
NAMED_M = 22.0  # a stripe that has room for the name of its ground
GAP_M = 3.0  # lines do not bridge a longer stretch without samples
SIGMAS, BINS = 5.0, 50  # of the histogram; what lies further out is not drawn
ERROR = 0.02  # of c_rr, ends of the colour scale: the step between gravel and dry dirt
COLOUR = {"nominal": pictures.VERMILION, "calibrated": pictures.BLUE, "harsh": pictures.PINK}
DASHES = {"kalman": "-", "rls": "--"}
PALE = 1 - 0.22 * (1 - ZONE_RGB)  # as a background
TRUTH: Any = {"color": "black", "lw": 2.2, "alpha": 0.6, "zorder": 2.5, "solid_joinstyle": "miter"}
PRESS_FROM, PRESS = 0.08, 5.0  # c_rr above the first is drawn that much smaller
ZONE_TICKS = [f"{zone.name}  {zone.c_rr:g}" for zone in ZONES]


def draw(_: Report, outcomes: Sequence[GroundOutcome], __: Runner, folder: Path) -> list[Path]:
    """Draw all pictures of a run into a folder; returns their paths."""
    if not outcomes:
        return []
    drawn: dict[str, Callable[[], Figure]] = {}
    rows = [GroundConfiguration(GOAL_ROW.estimator, preset) for preset in PICTURED]
    for seed in sorted({o.drive.seed for o in outcomes})[:SEEDS]:
        pictured = [o for o in outcomes if o.drive.seed == seed and o.row in rows]
        if shown := [o for o in pictured if len(o.comparison.placed.samples)]:
            drawn[f"along_seed{seed}"] = partial(draw_along, shown)
            drawn[f"places_seed{seed}"] = partial(draw_places, shown)
    return pictures.draw_all({**drawn, "summary": partial(draw_summary, outcomes)}, folder)


# --- along the track -------------------------------------------------------------------------------------------------


def draw_along(shown: Sequence[GroundOutcome]) -> Figure:
    """Resistance and slope over the distance driven: truth, estimates, and the bands that they state."""
    outcome = shown[0]
    figure, panels = plt.subplots(3, figsize=(WIDTH_IN, 7.6), sharex=True, height_ratios=(2.2, 1, 0.8))
    track = _window(outcome)
    zone = outcome.ground.zone(track.place_m)
    for axes in panels:
        _draw_zones(axes, track, zone)
        axes.grid(visible=False, axis="x")
        axes.set_xlim(track.driven_m[0], track.driven_m[-1])
    resistance, slope, error = panels
    _name_zones(resistance, track, zone)
    resistance.plot(track.driven_m, C_RR[zone], drawstyle="steps-mid", **TRUTH)
    slope.plot(track.driven_m, slope_deg(track.gradient, track.yaw_rad), **TRUTH)
    error.axhline(0, **TRUTH)
    for each in shown:
        _draw_estimate(panels, each.row.preset, _within(each.comparison.placed, track))
    resistance.set_yscale("function", functions=(_pressed, _stretched))
    resistance.set(ylim=(-0.012, 0.32), ylabel="rolling resistance $c_{rr}$ [-]")
    resistance.set_yticks(C_RR, ZONE_TICKS)
    slope.set_ylabel("slope ahead [deg]")
    error.set(ylim=(-1.5, 1.5), ylabel="its error [deg]", xlabel="true distance driven [m]")
    figure.legend(handles=_along_handles(shown), loc="outside lower center", ncols=6)
    head(figure, f"{_which(outcome)}: the estimate at the true place of each sample")
    return figure


def _which(outcome: GroundOutcome) -> str:
    return f"Seed {outcome.drive.seed}, route {outcome.drive.tour}"


def _draw_zones(axes: Axes, track: LoadTrack, zone: Ints) -> None:
    """Kinds of ground as pale stripes, and stretches driven in reverse as a bar at the foot."""
    for first, last in _runs(zone):
        axes.axvspan(track.driven_m[first], track.driven_m[last], color=PALE[zone[first]], lw=0, zorder=0)
    backwards = _backwards(track)
    for first, last in _runs(backwards.astype(int)):
        span = (track.driven_m[first], track.driven_m[last])
        if backwards[first] and span[1] - span[0] > 1:
            axes.axvspan(*span, ymin=0, ymax=0.03, color="black", lw=0, alpha=0.55, zorder=1)


def _name_zones(axes: Axes, track: LoadTrack, zone: Ints) -> None:
    for first, last in _runs(zone):
        west, east = track.driven_m[first], track.driven_m[last]
        if east - west > NAMED_M:
            place: Any = {"ha": "center", "va": "top", "transform": axes.get_xaxis_transform()}
            axes.text((west + east) / 2, 0.985, ZONES[zone[first]].name, fontsize=8, color="#444444", **place)


def _draw_estimate(panels: Sequence[Axes], preset: str, placed: PlacedSamples) -> None:
    """Estimates as lines, with two standard deviations to each side."""
    colour, track = COLOUR[preset], placed.track
    slopes = slope_deg(placed.gradient, track.yaw_rad)
    slope_std = np.degrees(np.sqrt(placed.samples["grade_var"].astype(float)))
    c_rr_std = np.sqrt(placed.samples["c_rr_var"].astype(float))
    gaps = np.flatnonzero(np.diff(track.driven_m, prepend=track.driven_m[:1]) > GAP_M)
    errors = slopes - slope_deg(track.gradient, track.yaw_rad)
    columns = ((placed.c_rr, c_rr_std), (slopes, slope_std), (errors, slope_std))
    for axes, (values, std) in zip(panels, columns, strict=True):
        x, mean, half = (np.insert(column, gaps, np.nan) for column in (track.driven_m, values, 2 * std))
        axes.fill_between(x, mean - half, mean + half, color=colour, alpha=0.22, lw=0, zorder=2)
        axes.plot(x, mean, color=colour, lw=1.1, zorder=3 + 2 * (preset == GOAL_ROW.preset))


def _along_handles(shown: Sequence[GroundOutcome]) -> list[Any]:
    return [
        Line2D([], [], label="truth", **TRUTH),
        *(Line2D([], [], color=COLOUR[o.row.preset], label=o.row.preset) for o in shown),
        Patch(color="grey", alpha=0.3, lw=0, label="two standard deviations"),
        Patch(color="black", alpha=0.55, lw=0, label="in reverse"),
    ]


def _window(outcome: GroundOutcome) -> LoadTrack:
    """The first stretch of the track that is judged, as far as a picture can show it."""
    track = outcome.track
    first = int(np.searchsorted(track.stamp_ns, outcome.from_ns))
    begin_m = track.driven_m[min(first, len(track.driven_m) - 1)]
    last = int(np.searchsorted(track.driven_m, begin_m + WINDOW_M, side="right"))
    return track.at(track.stamp_ns[first:last])


def _within(placed: PlacedSamples, track: LoadTrack) -> PlacedSamples:
    """The samples of a stretch."""
    here = (placed.track.stamp_ns >= track.stamp_ns[0]) & (placed.track.stamp_ns <= track.stamp_ns[-1])
    columns = (placed.zone, placed.border_m, placed.slope, placed.is_edge)
    there = placed.track.at(placed.track.stamp_ns[here])
    return PlacedSamples(placed.samples[here], there, *(column[here] for column in columns))


def _backwards(track: LoadTrack) -> Bools:
    """Where the load centre moves against the heading."""
    step = np.gradient(track.place_m, axis=0)
    against: Bools = (step * np.stack([np.cos(track.yaw_rad), np.sin(track.yaw_rad)], axis=-1)).sum(axis=-1) < -0.01
    return against


def _runs(values: Ints) -> list[tuple[int, int]]:
    """First index of each run of equal values, and that of the next run, or of the last value."""
    first = [0, *(np.flatnonzero(np.diff(values)) + 1).tolist()]
    return list(zip(first, [*first[1:], len(values) - 1], strict=True))


def _pressed(values: AnyArray) -> AnyArray:
    """A scale that shows sand as well, and what tells concrete, gravel and dirt apart."""
    return np.where(values < PRESS_FROM, values, PRESS_FROM + (values - PRESS_FROM) / PRESS)


def _stretched(values: AnyArray) -> AnyArray:
    return np.where(values < PRESS_FROM, values, PRESS_FROM + (values - PRESS_FROM) * PRESS)


# --- over the site ---------------------------------------------------------------------------------------------------


def draw_places(shown: Sequence[GroundOutcome]) -> Figure:
    """The site from above: samples by their error, those of a wrong class marked."""
    figure, panels = plt.subplots(1, len(shown), figsize=(WIDTH_IN, 5.3), sharex=True, sharey=True, squeeze=False)
    for axes, each in zip(panels[0], shown, strict=True):
        dots = _draw_site(axes, each)
        axes.set_xlabel(EAST)
    panels[0, 0].set_ylabel(NORTH)
    figure.colorbar(dots, ax=panels, shrink=0.8, pad=0.01, extend="both", label="error of $c_{rr}$ [-]")
    handles: list[Any] = [Patch(color=colour, label=zone.name) for colour, zone in zip(PALE, ZONES, strict=True)]
    handles.append(Line2D([], [], color="magenta", marker="x", ls="", mew=1.3, label="wrong class"))
    figure.legend(handles=handles, loc="outside lower center", ncols=6)
    head(figure, f"{_which(shown[0])}: samples where the machine truly was")
    return figure


def _draw_site(axes: Axes, outcome: GroundOutcome) -> Any:
    terrain, placed = outcome.ground.terrain, outcome.comparison.placed
    rows, columns = terrain.zones.shape
    extent = (0.0, columns * terrain.zone_cell_m, 0.0, rows * terrain.zone_cell_m)
    axes.imshow(PALE[terrain.zones], origin="lower", extent=extent, interpolation="nearest")
    known = np.isfinite(placed.c_rr)
    x, y = placed.track.place_m[known].T
    error, wrong = placed.c_rr_error[known], ~placed.is_right[known]
    axes.scatter(x, y, color="#333333", s=34, lw=0, zorder=2)  # sets small errors off from the ground
    dots = axes.scatter(x, y, c=error, cmap="coolwarm", vmin=-ERROR, vmax=ERROR, s=14, lw=0, zorder=3)
    axes.scatter(x[wrong], y[wrong], color="magenta", marker="x", s=16, lw=0.9, zorder=4)
    share = 100 * wrong.mean() if len(wrong) else np.nan
    head(axes, f"{outcome.row.preset}: {share:.1f} % of samples wrong", 9)
    axes.grid(visible=False)
    return dots


# --- all rows --------------------------------------------------------------------------------------------------------


def draw_summary(outcomes: Sequence[GroundOutcome]) -> Figure:
    """Wrong cells by distance to a border, and how large errors are beside what the estimate states."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(WIDTH_IN, 4.4))
    drawn = {outcome.row for outcome in outcomes}
    for row in [row for row in ROWS if row in drawn]:
        comparison: Comparison = pool([o.comparison for o in outcomes if o.row == row])
        _draw_by_border(left, row, comparison.cells)
        _draw_normalised(right, row, comparison.placed)
    left.set(xlabel="distance of the cell from the nearest border [m]", ylabel="cells of a wrong class [%]")
    left.set_ylim(0, 1.3 * left.get_ylim()[1])
    x = np.linspace(-SIGMAS, SIGMAS, 200)
    right.plot(x, np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi), color="black", lw=1.2, label="right: 1")
    right.set_xlabel(f"error of $c_{{rr}}$ over its stated standard deviation, more than {INTERIOR_M:g} m from borders")
    right.set(ylabel="density", xlim=(-SIGMAS, SIGMAS), ylim=(0, 1.5 * right.get_ylim()[1]))
    left.legend(ncols=2, loc="upper right")
    right.legend(title="and root mean square", alignment="left", ncols=2, loc="upper left")
    seeds = len({o.drive.seed for o in outcomes})
    head(figure, f"{seeds} seeds of {outcomes[0].drive.seconds:g} s, every row on the same recordings")
    return figure


def _draw_by_border(axes: Axes, row: GroundConfiguration, cells: CellMeans) -> None:
    parts = by_border(cells)
    ticks = [f"{p['from_m']:g} to {p['to_m']:g}" if p["to_m"] else f"over {p['from_m']:g}" for p in parts]
    wrong = [part["wrong_pct"] for part in parts]
    label = f"{row.estimator}, {row.preset}"
    axes.plot(wrong, DASHES[row.estimator], color=COLOUR[row.preset], marker="o", ms=4, lw=1.3, label=label)
    axes.set_xticks(range(len(ticks)), ticks)


def _draw_normalised(axes: Axes, row: GroundConfiguration, placed: PlacedSamples) -> None:
    errors = placed.normalised_error[np.isfinite(placed.c_rr) & (placed.border_m > INTERIOR_M)]
    if not len(errors):
        return
    edges = np.linspace(-SIGMAS, SIGMAS, BINS + 1)
    counts, _ = np.histogram(errors, edges)
    label = f"{row.estimator}, {row.preset}: {np.sqrt((errors**2).mean()):.2f}"
    density = counts / len(errors) / (edges[1] - edges[0])
    axes.stairs(density, edges, color=COLOUR[row.preset], ls=DASHES[row.estimator], lw=1.2, label=label)
