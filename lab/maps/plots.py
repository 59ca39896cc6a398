"""Pictures of merged maps: truth and two merges of each case side by side, and all cases by method."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import hsv_to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch

from lab.campaign import pictures
from lab.campaign.experiment import Runner
from lab.campaign.pictures import EAST, NORTH, ZONE_RGB, head
from lab.campaign.workers import each
from lab.maps.cases import CELL_M, MapCase, parking_place
from lab.maps.experiment import GOALS, GRADE_TOLERANCE, NEAR_M, SERVER, Maps, classes, figures, solve
from lab.maps.methods import METHODS, Layers
from protocol.arrays import Floats
from protocol.site.ground_classes import UNKNOWN, ZONES, resistance_class
from sitegrid.proof.figures import Report, Row, select

SHOWN = (SERVER, "last_write")
UNKNOWN_RGB = (0.88, 0.88, 0.88)
WRONG_RGB = (1.0, 0.0, 1.0)
PALENESS = 0.2  # of the true ground behind wrong cells
COLOURS = (pictures.BLUE, pictures.VERMILION, pictures.ORANGE, pictures.GREEN, pictures.PINK)
COLOUR = dict(zip((SERVER, *METHODS), COLOURS, strict=True))
BESIDE_ROAD_M = 15.0  # of a narrow road that is shown; the rest of the site is all the same
LOWEST_PCT = 0.005  # bottom of the bars' scale: three cells of the site
LABEL_ROOM = 1.6  # a goal that is less than so many times higher would cross the value above a bar

# Groups of bars: what a row is, its figure, and the words below.
BARS: tuple[tuple[dict[str, Any], str, str], ...] = (
    ({"case": "1x1"}, "wrong_pct", "1 machine\n1 pass"),
    ({"case": "1x4"}, "wrong_pct", "1 machine\n4 passes"),
    ({"case": "4x4"}, "wrong_pct", "4 machines\n4 passes"),
    ({"case": "bad_machine"}, "wrong_pct", "4 x 4,\none bad"),
    ({"case": "mixed_receivers"}, "wrong_pct", "mixed\nreceivers"),
    ({"case": "parked_bad_machine"}, "wrong_pct", "4 x 1, a bad\none parked"),
    ({"case": "parked_bad_machine"}, "near_wrong_pct", "the same,\nbeside it"),
    ({"case": "repaved", "passes_after": 1}, "changed_wrong_pct", "repaved,\n1 pass after"),
    ({"case": "repaved", "passes_after": 2}, "changed_wrong_pct", "repaved,\n2 after"),
    ({"case": "repaved", "passes_after": 1}, "unchanged_wrong_pct", "not repaved,\n1 pass after"),
    ({"case": "narrow_road", "width_m": 3}, "wrong_pct", "road of\n3 m"),
    ({"case": "narrow_road", "width_m": 6}, "wrong_pct", "road of\n6 m"),
    ({"case": "grade_both_ways"}, "wrong_pct", "gradient,\nboth ways"),
    ({"case": "slope_15"}, "wrong_pct", "gradient,\n15 degrees"),
)


def draw(report: Report, cases: Sequence[MapCase], runner: Runner, folder: Path) -> list[Path]:
    """Draw the table, and the maps of each case with the first seed, into a folder; returns the paths."""
    jobs = [(case, report["seeds"][0], folder) for case in cases]
    paths = {case: path for (case, _, _), path in each(_draw_case, jobs, runner.processes)}
    return [*pictures.draw_all({"table": partial(draw_table, report)}, folder), *(paths[case] for case in cases)]


def _draw_case(job: tuple[MapCase, int, Path]) -> Path:
    case, seed, folder = job
    (path,) = pictures.draw_all({case.name: partial(draw_maps, case, seed, solve(case, seed))}, folder)
    return path


# --- maps of one case ------------------------------------------------------------------------------------------------


def draw_maps(case: MapCase, seed: int, maps: Maps) -> Figure:
    """Truth and two merges in the upper row; below, how sure the server is (or a key), and their wrong cells."""
    figure, panels = plt.subplots(2, 3, figsize=(pictures.WIDTH_IN + 3, 8.6))
    shown = [(name, maps.layers[name]) for name in SHOWN]
    for axes, (name, layers) in zip(panels[0], [("truth", _true_layers(maps)), *shown], strict=True):
        _image(axes, case, _picture(case, layers))
        head(axes, name)
    for axes, (name, layers) in zip(panels[1, 1:], shown, strict=True):
        _draw_wrong(axes, case, maps, layers)
        judged = figures(case, maps.scene, layers)
        wrong = math.nan if judged["wrong_pct"] is None else judged["wrong_pct"]
        head(axes, f"{name}: {wrong:.2f} % wrong{_parts(judged)}")
        axes.set_xlabel(EAST)
    if case.judges_grade:
        _draw_wheel(panels[1, 0], case)
    else:
        _draw_confidence(figure, panels[1, 0], case, maps.layers[SERVER]["confidence"])
    for axes in panels.flat[[0, 1, 2, 4, 5]]:
        _draw_marks(axes, case, maps)
    panels[0, 0].set_ylabel(NORTH)
    figure.legend(handles=_handles(case), loc="outside lower center", ncols=8)
    machines = _count(len(case.machines), "machine")
    head(figure, f"{case.title}, seed {seed}: {maps.scene.samples:,} samples of {machines}", 11)
    return figure


def _true_layers(maps: Maps) -> Layers:
    site = maps.scene.site
    east, north = np.moveaxis(site.gradient, -1, 0)
    return {"resistance": site.c_rr_later, "grade_east": east, "grade_north": north}


def _parts(judged: Row) -> str:
    """Figures of a case's own, for a title."""
    words = {"changed_wrong_pct": "changed", "unchanged_wrong_pct": "unchanged", "near_wrong_pct": "beside the machine"}
    parts = [f"{word} {judged[name]:.2f}" for name, word in words.items() if judged[name] is not None]
    return f"\n{', '.join(parts)}" if parts else ""


def _image(axes: Axes, case: MapCase, rgb: Any, **options: Any) -> Any:
    extent = (0.0, case.columns * CELL_M, 0.0, case.rows * CELL_M)
    axes.grid(visible=False)
    image = axes.imshow(rgb, origin="lower", extent=extent, interpolation="nearest", **options)
    if case.width_m is not None:
        middle = case.rows * CELL_M / 2
        axes.set_ylim(middle - BESIDE_ROAD_M, middle + BESIDE_ROAD_M)
        axes.set_aspect("auto")
    return image


def _picture(case: MapCase, layers: Layers) -> Floats:
    """Colours (rows, columns, 3) of a map."""
    if case.judges_grade:
        return _gradient_rgb(layers["grade_east"], layers["grade_north"], _steepest(case))
    zone = resistance_class(layers["resistance"])
    return np.where((zone == UNKNOWN)[..., None], UNKNOWN_RGB, ZONE_RGB[np.maximum(zone, 0)])


def _gradient_rgb(east: Floats, north: Floats, steepest: float) -> Floats:
    """Hue is the direction uphill, and the steeper the stronger."""
    known = np.isfinite(east) & np.isfinite(north)
    east, north = np.where(known, east, 0), np.where(known, north, 0)
    hue = np.arctan2(north, east) / (2 * np.pi) % 1
    strong = np.clip(np.hypot(east, north) / steepest, 0, 1)
    rgb = hsv_to_rgb(np.stack([hue, strong, 1 - 0.15 * strong], axis=-1))
    return np.where(known[..., None], rgb, UNKNOWN_RGB)


def _steepest(case: MapCase) -> float:
    return max(math.hypot(*gradient) for gradient in case.gradients)


def _draw_wrong(axes: Axes, case: MapCase, maps: Maps, layers: Layers) -> None:
    """Wrong cells over the pale truth; what is not judged is white."""
    estimated, true = classes(case, maps.scene, layers)
    judged = maps.scene.driven & maps.scene.site.judged
    rgb = 1 - PALENESS * (1 - _picture(case, _true_layers(maps)))
    rgb[judged & (estimated == UNKNOWN)] = UNKNOWN_RGB
    rgb[~judged] = 1.0
    rgb[judged & (estimated != UNKNOWN) & (estimated != true)] = WRONG_RGB
    _image(axes, case, rgb)


def _draw_confidence(figure: Figure, axes: Axes, case: MapCase, confidence: Floats) -> None:
    image = _image(axes, case, confidence, cmap="viridis", vmin=0.3, vmax=1.0)
    head(axes, f"{SERVER}: confidence")
    axes.set(xlabel=EAST, ylabel=NORTH)
    bar = axes.inset_axes((0.0, -0.3, 1.0, 0.05))  # a colour bar beside the panel would make it smaller than the others
    label = "share of the votes that the leading class has [-]"
    figure.colorbar(image, cax=bar, orientation="horizontal", label=label)


def _draw_wheel(axes: Axes, case: MapCase) -> None:
    """Key of the colours of gradients."""
    steepest = 100 * _steepest(case)
    east, north = np.meshgrid(*[np.linspace(-steepest, steepest, 201)] * 2)
    rgb = _gradient_rgb(east, north, steepest)
    rgb[np.hypot(east, north) > steepest] = 1.0
    axes.imshow(rgb, origin="lower", extent=(-steepest, steepest, -steepest, steepest))
    for each_east, each_north in case.gradients:
        axes.plot(100 * each_east, 100 * each_north, "o", color="black", ms=5, mfc="none", clip_on=False)
    head(axes, "key; circles: the zones")
    axes.set(xlabel="grade to the east [%]", ylabel="grade to the north [%]")


def _draw_marks(axes: Axes, case: MapCase, maps: Maps) -> None:
    """Outline of what was repaved, and the ring that a parked machine reaches."""
    if maps.scene.site.repaved.any():
        x, y = ((np.arange(count) + 0.5) * CELL_M for count in (case.columns, case.rows))
        axes.contour(x, y, maps.scene.site.repaved, levels=[0.5], colors="black", linewidths=1.2, linestyles="--")
    for machine in (m for m in case.machines if m.parked):
        x_m, y_m = parking_place(case)
        for colour, width in (("white", 3.0), ("black", 1.2)):
            axes.add_patch(Circle((x_m + machine.offset_m, y_m), 3 * NEAR_M, fill=False, color=colour, lw=width))


def _handles(case: MapCase) -> list[Any]:
    handles: list[Any] = []
    if not case.judges_grade:
        handles += [Patch(color=rgb, label=f"{z.name} {z.c_rr:g}") for rgb, z in zip(ZONE_RGB, ZONES, strict=True)]
    wrong = f"off by more than {100 * GRADE_TOLERANCE:g} % grade" if case.judges_grade else "wrong class"
    handles += [Patch(color=WRONG_RGB, label=wrong), Patch(color=UNKNOWN_RGB, label="unknown")]
    if case.passes_after is not None:
        handles.append(Line2D([], [], color="black", ls="--", lw=1.2, label="repaved"))
    if any(machine.parked for machine in case.machines):
        handles.append(Line2D([], [], color="black", marker="o", mfc="none", ls="", label="parked machine"))
    return handles


# --- all cases -------------------------------------------------------------------------------------------------------


def draw_table(report: Report) -> Figure:
    """Wrong cells of all cases by method, on a logarithmic scale: medians, ranges over the seeds, and goals."""
    groups = [group for group in BARS if select(report["rows"], group[0])]
    figure, axes = plt.subplots(figsize=(max(6.0, 1.05 * len(groups) + 1.5), 5.0))
    wide = 0.84 / len(COLOUR)
    for x, (values, name, _) in enumerate(groups):
        for i, method in enumerate((SERVER, *METHODS)):
            (row,) = select(report["rows"], {**values, "method": method})
            if row[name] is not None:
                _draw_bar(axes, x + (i - (len(COLOUR) - 1) / 2) * wide, wide, row, name)
    axes.set(yscale="log", ylim=(LOWEST_PCT, 250.0), xlim=(-0.6, len(groups) - 0.4))
    axes.set_yticks([0.01, 0.1, 1, 10, 100], ["0.01", "0.1", "1", "10", "100"])
    axes.set_xticks(range(len(groups)), [words for _, _, words in groups])
    axes.grid(visible=False, axis="x")
    axes.set_ylabel("driven cells that are wrong [%]")
    handles: list[Any] = [Patch(color=colour, label=name) for name, colour in COLOUR.items()]
    handles.append(Line2D([], [], color="black", lw=2, label=f"goal of {SERVER}"))
    axes.legend(handles=handles, ncols=6, loc="upper left")
    head(axes, f"Medians of {_count(len(report['seeds']), 'seed')}, whiskers from the best to the worst")
    return figure


def _draw_bar(axes: Axes, x: float, wide: float, row: Row, name: str) -> None:
    """One bar; above that of the server its value, free of whisker and goal."""
    top = max(row[name], LOWEST_PCT)
    axes.bar(x, top, wide * 0.92, color=COLOUR[row["method"]])
    if name == "wrong_pct":
        low, high = (max(row[end] or 0.0, LOWEST_PCT) for end in ("wrong_min_pct", "wrong_max_pct"))
        axes.plot([x, x], [low, high], color="black", lw=1)
        top = max(top, high)
    for limit in _limits(row, name):
        axes.plot([x - 0.7 * wide, x + 0.7 * wide], [limit, limit], color="black", lw=2, zorder=4)
        top = limit if top < limit < LABEL_ROOM * top else top
    if row["method"] == SERVER:
        axes.text(x, top * 1.12, f"{row[name]:.2g}", ha="center", va="bottom", fontsize=7, weight="bold")


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def _limits(row: Row, name: str) -> list[float]:
    """The goals of the server's bar."""
    goals = [goal for goal in GOALS if (goal.figure, goal.relation) == (name, "<=") and row["method"] == SERVER]
    return [goal.limit for goal in goals if select([row], goal.row)]
