"""Pictures like the paper's: true maps, plotted maps, wrong cells in white, tracks, errors over time, and reliability.

Maps, tracks and errors are those of the first seed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from lab.calibration.drives import scene
from lab.campaign import pictures
from lab.campaign.experiment import Runner
from lab.campaign.pictures import EAST, NORTH, ZONE_RGB, head
from lab.campaign.recordings import load
from lab.maps.cases import CELL_M
from lab.maps.uncertainty import BINS
from lab.paper.experiment import MapOutcome, Outcomes
from lab.paper.maps import FORECASTS, OURS, PAPERS, SERVED, MapKind, samples_of
from mapserver.pictures.plotter import NamedLayers
from protocol.arrays import AnyArray, Floats, Ints
from protocol.machine.readings import Gps
from protocol.site.ground_classes import SLOPE, UNKNOWN, ZONES, resistance_class, slope_class, wrong_percent
from sitegrid.proof.figures import Report, Row
from sitegrid.proof.map_score import true_layers

GRADE_RGB = ZONE_RGB[:2]  # flat and slope, as in the paper
UNKNOWN_RGB = (0.88, 0.88, 0.88)
BEHIND_RGB, WRONG_RGB = (0.1, 0.1, 0.1), (1.0, 1.0, 1.0)  # of difference maps: what was not plotted, what is wrong
DARKNESS = 0.5  # of right cells there
WINDOW_S = 120.0  # of errors over time that outages are marked in
LAP_S = 180.0  # of tracks: about a lap, since many laps over each other show nothing
TRUE_COLOUR, BELIEVED_COLOUR = "#D62728", "#1F77B4"  # red and blue, as the paper's tracks
METHODS = {SERVED.merge: pictures.BLUE, **dict(zip(FORECASTS, (pictures.VERMILION, pictures.ORANGE), strict=True))}
PANEL_IN = 3.1
Titled = tuple[str, MapOutcome, MapKind]


def draw(report: Report, outcomes: Outcomes, runner: Runner, folder: Path) -> list[Path]:
    """Draw all pictures of a report into a folder; returns their paths."""
    maps, fleets = (_shown(outcomes, several=several) for several in (False, True))
    alone = [outcomes.all_of(source)[0] for source in outcomes.plan.sources if source.machines == 1]
    drawn: dict[str, Callable[[], Figure]] = {
        "truth": partial(draw_truth, maps[0][1], runner),
        "maps": partial(draw_maps, maps, runner),
        "differences": partial(draw_differences, maps, runner),
        "fleet_maps": partial(draw_maps, fleets, runner),
        "fleet_differences": partial(draw_differences, fleets, runner),
        "tracks": partial(draw_tracks, alone, runner),
        "errors": partial(draw_errors, alone, runner),
    }
    if report["forecasts"]:
        drawn["reliability"] = partial(draw_reliability, report["forecasts"])
    return pictures.draw_all(drawn, folder)


def _shown(outcomes: Outcomes, *, several: bool) -> list[Titled]:
    """The maps that are shown: of one machine the paper's of each configuration, then this project's; or of fleets."""
    out: list[Titled] = []
    for source in outcomes.plan.sources:
        if several != (source.machines > 1):
            continue
        first, row = outcomes.all_of(source)[0], source.configuration
        name = f"{row.filter.upper()}, {row.imu} IMU, {row.gps} GPS"
        if source.machines == 1 and row.profile == "paper":
            out.append((f"the paper's plotter\n{name}", first, PAPERS))
        elif source.machines == 1 and row.filter == "ukf" and row.gps == 2:
            out.append((f"soft votes, true values\n{name}", first, OURS))
        elif several:
            site = f"{source.machines} machines, {source.scenario} {source.preset}"
            out += [
                (f"{values}\n{site}", first, kind) for values, kind in (("true values", OURS), ("estimates", SERVED))
            ]
    return out


# --- maps ------------------------------------------------------------------------------------------------------------


def _classes(layers: NamedLayers) -> tuple[Ints, Ints]:
    """Classes of resistance and of grade."""
    return resistance_class(layers["resistance"]), slope_class(layers["grade_east"], layers["grade_north"])


def _rgb(classes: Ints, palette: Floats, unknown: AnyArray | tuple[float, ...] = UNKNOWN_RGB) -> Floats:
    """Colours (rows, columns, 3)."""
    out: Floats = np.where((classes == UNKNOWN)[..., None], unknown, palette[np.maximum(classes, 0)])
    return out


def _image(axes: Axes, rgb: Floats) -> None:
    rows, columns = rgb.shape[:2]
    axes.grid(visible=False)
    axes.imshow(rgb, origin="lower", extent=(0.0, columns * CELL_M, 0.0, rows * CELL_M), interpolation="nearest")


def _grid(count: int, rows: int) -> tuple[Figure, Any]:
    """A figure of so many columns of maps."""
    size = (PANEL_IN * count, 2.6 * rows + 0.8)
    return plt.subplots(rows, count, figsize=size, squeeze=False, sharex=True, sharey=True)


def _finish(figure: Figure, panels: Any, handles: Sequence[Any], title: str) -> Figure:
    for axes in panels[-1]:
        axes.set_xlabel(EAST)
    for axes in panels[:, 0]:
        axes.set_ylabel(NORTH)
    figure.legend(handles=list(handles), loc="outside lower center", ncols=len(handles))
    head(figure, title, 10)
    return figure


def _key(*more: Patch) -> list[Patch]:
    zones = [Patch(color=rgb, label=f"{z.name} {z.c_rr:g}") for rgb, z in zip(ZONE_RGB, ZONES, strict=True)]
    slope = Patch(color=tuple(GRADE_RGB[SLOPE]), label="slope, 15 degrees; flat is green")
    return [*zones, slope, *more]


def draw_truth(outcome: MapOutcome, runner: Runner) -> Figure:
    """The true maps of resistance and of grade."""
    figure, panels = _grid(2, 1)
    classes = _classes(true_layers(scene(outcome.drive, runner.cache).truth))
    parts = zip(panels[0], classes, (ZONE_RGB, GRADE_RGB), ("rolling resistance", "grade"), strict=True)
    for axes, kind, palette, name in parts:
        _image(axes, _rgb(kind, palette))
        head(axes, name)
    figure.set_size_inches(2.2 * PANEL_IN + 2, 4.2)
    return _finish(figure, panels, _key(), "Ground truth")


def draw_maps(maps: Sequence[Titled], _: Runner) -> Figure:
    """The maps as they were plotted: resistance above, grade below."""
    figure, panels = _grid(len(maps), 2)
    for column, (title, outcome, kind) in zip(panels.T, maps, strict=True):
        for axes, classes, palette in zip(
            column, _classes(outcome.made.layers_of(kind)), (ZONE_RGB, GRADE_RGB), strict=True
        ):
            _image(axes, _rgb(classes, palette))
        head(column[0], title, 8)
    return _finish(figure, panels, _key(Patch(color=UNKNOWN_RGB, label="not known")), _seed("Plotted maps", maps))


def draw_differences(maps: Sequence[Titled], runner: Runner) -> Figure:
    """Wrong cells in white, on what was plotted; J is that of all plotted cells, as in the paper."""
    figure, panels = _grid(len(maps), 2)
    for column, (title, outcome, kind) in zip(panels.T, maps, strict=True):
        true = _classes(true_layers(scene(outcome.drive, runner.cache).truth))
        names, palettes = ("J_r", "J_s"), (ZONE_RGB, GRADE_RGB)
        parts = zip(column, _classes(outcome.made.layers_of(kind)), true, palettes, names, strict=True)
        for axes, classes, true_classes, palette, name in parts:
            rgb = _rgb(classes, DARKNESS * palette + (1 - DARKNESS) / 2, BEHIND_RGB)
            rgb[(classes != UNKNOWN) & (classes != true_classes)] = WRONG_RGB
            _image(axes, rgb)
            axes.text(
                0.02,
                0.03,
                f"{name} {wrong_percent(classes, true_classes):.2f} %",
                transform=axes.transAxes,
                color="white",
            )
        head(column[0], title, 8)
    wrong = Patch(facecolor=WRONG_RGB, edgecolor="black", label="wrong class")
    handles = [wrong, Patch(color=BEHIND_RGB, label="not known")]
    return _finish(figure, panels, handles, _seed("Difference from the truth: resistance above, grade below", maps))


def _seed(title: str, maps: Sequence[Titled]) -> str:
    return f"{title}; seed {maps[0][1].drive.seed}"


# --- tracks ----------------------------------------------------------------------------------------------------------


def _places(outcome: MapOutcome, runner: Runner) -> tuple[Floats, Floats, Floats]:
    """Seconds (n,), believed and true places (n, 2) of the samples of a lone machine, as known at once."""
    (agent,) = outcome.source.agents
    rows = samples_of(agent, outcome.drive, runner.cache).live
    (track,) = scene(outcome.drive, runner.cache).tracks.values()
    time_s = np.asarray(rows["stamp_ns"] - track.stamp_ns[0], float) * 1e-9
    return time_s, np.stack([rows["x_m"], rows["y_m"]], axis=1), track.at(rows["stamp_ns"]).place_m


def draw_tracks(alone: Sequence[MapOutcome], runner: Runner) -> Figure:
    """True and believed tracks of each configuration: those of the paper's filter above, this project's below."""
    profiles = _by_profile(alone)
    figure, panels = _grid(max(map(len, profiles.values())), len(profiles))
    for line, (profile, outcomes) in zip(panels, profiles.items(), strict=True):
        for axes, outcome in zip(line, outcomes, strict=True):
            time_s, believed_m, true_m = _places(outcome, runner)
            last = time_s > time_s[-1] - LAP_S
            believed_m, true_m = believed_m[last], true_m[last]
            axes.plot(*true_m.T, color=TRUE_COLOUR, lw=1.0, label="truth")
            axes.plot(*believed_m.T, color=BELIEVED_COLOUR, lw=0.7, label="believed at once")
            head(axes, f"{_name(outcome)}, {profile}", 8)
            axes.set_aspect("equal")
    handles, _ = panels[0, 0].get_legend_handles_labels()
    return _finish(figure, panels, handles, f"Tracks of load centres, the last {LAP_S:g} s; seed {alone[0].drive.seed}")


def draw_errors(alone: Sequence[MapOutcome], runner: Runner) -> Figure:
    """Errors over two minutes, with the times in which each receiver was lost."""
    profiles = _by_profile(alone)
    groups = next(iter(profiles.values()))
    figure, panels = plt.subplots(len(groups), figsize=(pictures.WIDTH_IN, 2.1 * len(groups) + 0.6), squeeze=False)
    seconds = alone[0].drive.seconds
    start_s = max(0.0, (seconds - WINDOW_S) / 2)
    for i, axes in enumerate(panels[:, 0]):
        for profile, colour in zip(profiles, (pictures.VERMILION, pictures.BLUE), strict=False):
            time_s, believed_m, true_m = _places(profiles[profile][i], runner)
            axes.plot(time_s, np.hypot(*(believed_m - true_m).T), color=colour, lw=1.2, label=profile)
        _mark_outages(axes, groups[i], runner)
        head(axes, _name(groups[i]), 9)
        axes.set(xlim=(start_s, min(start_s + WINDOW_S, seconds)), ylabel="error [m]")
        axes.set_ylim(bottom=0)
    panels[0, 0].legend(loc="upper right", ncols=4)
    panels[-1, 0].set_xlabel("time [s]")
    title = (
        f"Distance from the truth, as known at once; seed {alone[0].drive.seed}. Grey: a receiver is lost, one row each"
    )
    head(figure, title, 9, "normal")
    return figure


def _mark_outages(axes: Axes, outcome: MapOutcome, runner: Runner) -> None:
    """Grey spans where a receiver that is used gave no fix, those of each in a stripe of its own."""
    recording = load(outcome.drive.folder(runner.cache))
    first_ns = int(recording.truth.stamp_ns[0])
    receivers = sorted({reading.sensor for reading in recording.readings if isinstance(reading, Gps)})
    count = outcome.source.configuration.gps
    for i, receiver in enumerate(receivers[:count]):
        stamps = [reading.stamp_ns for reading in recording.readings if reading.sensor == receiver]
        time_s = (np.array(stamps) - first_ns) * 1e-9
        gap_s = np.diff(time_s)
        for start in np.flatnonzero(gap_s > 1.5 * np.median(gap_s)):
            axes.axvspan(time_s[start], time_s[start + 1], i / count, (i + 1) / count, color="grey", alpha=0.25, lw=0)


def _by_profile(alone: Sequence[MapOutcome]) -> dict[str, list[MapOutcome]]:
    profiles = dict.fromkeys(outcome.source.configuration.profile for outcome in alone)
    return {name: [each for each in alone if each.source.configuration.profile == name] for name in profiles}


def _name(outcome: MapOutcome) -> str:
    row = outcome.source.configuration
    return f"{row.filter.upper()}, {row.imu} IMU, {row.gps} GPS"


# --- how far maps are believed ---------------------------------------------------------------------------------------


def draw_reliability(forecasts: Sequence[Row]) -> Figure:
    """Share of right cells over the confidence that was stated, and how many cells each bin has."""
    sites = list(dict.fromkeys((row["scenario"], row["preset"]) for row in forecasts))
    figure, panels = plt.subplots(
        2, len(sites), figsize=(4.2 * len(sites) + 0.6, 5.6), squeeze=False, height_ratios=(3, 1)
    )
    for column, site in zip(panels.T, sites, strict=True):
        here = [row for row in forecasts if (row["scenario"], row["preset"]) == site]
        column[0].plot([0, 1], [0, 1], color="black", lw=0.8, ls=":")
        for i, row in enumerate(here):
            _draw_bins(column, row, i, len(here))
        head(column[0], " ".join(site), 9)
        column[0].set(xlim=(0, 1), ylim=(0, 1.02), ylabel="share that is right")
        column[1].set(xlim=(0, 1), yscale="log", ylabel="cells", xlabel="confidence")
        column[0].legend(loc="lower right")
    head(
        figure, "Reliability over driven cells, all seeds; on the dotted line confidence is what is right", 9, "normal"
    )
    return figure


def _draw_bins(column: Any, row: Mapping[str, Any], i: int, count: int) -> None:
    bins = [each for each in row["reliability"] if each["cells"]]
    colour, wide = METHODS[row["method"]], 0.8 / BINS / count
    label = f"{row['method']}: error {row['calibration_error']:.3f}"
    column[0].plot([b["said"] for b in bins], [b["right"] for b in bins], "o-", color=colour, ms=3, label=label)
    places = [(b["from"] + b["to"]) / 2 + (i - (count - 1) / 2) * wide for b in bins]
    column[1].bar(places, [b["cells"] for b in bins], wide, color=colour)
