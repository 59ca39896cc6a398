"""Pictures like the paper's, first seed: true maps, plotted maps, wrong cells in white."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib as mpl

mpl.use("Agg")  # no display

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from lab.calibration.drives import scene
from lab.campaign.experiment import Runner
from lab.campaign.true_maps import true_layers
from lab.maps.cases import CELL_M
from lab.paper.experiment import MapOutcome, Outcomes
from lab.paper.maps import OURS, PAPERS, SERVED, MapKind
from mapserver.pictures.plotter import NamedLayers
from protocol.arrays import AnyArray, Floats, Ints
from protocol.site.ground_classes import SLOPE, UNKNOWN, ZONES, resistance_class, slope_class, wrong_percent

DPI, PANEL_IN = 110, 3.1
STYLE: Any = {"figure.constrained_layout.use": True, "font.size": 9, "legend.frameon": False, "savefig.bbox": "tight"}
# The paper's colours, as its pictures are compared; green, red, black, yellow, blue for ZONES.
ZONE_RGB: Floats = np.array([(40, 160, 60), (215, 40, 40), (35, 35, 35), (250, 215, 40), (30, 95, 205)]) / 255
GRADE_RGB = ZONE_RGB[:2]  # flat and slope, as in the paper
UNKNOWN_RGB = (0.88, 0.88, 0.88)
BEHIND_RGB, WRONG_RGB = (0.1, 0.1, 0.1), (1.0, 1.0, 1.0)  # of difference maps: not plotted, wrong
DARKNESS = 0.5  # of right cells there
Titled = tuple[str, MapOutcome, MapKind]


def draw(outcomes: Outcomes, runner: Runner, folder: Path) -> list[Path]:
    """Draw all pictures as NAME.png into a folder; returns their paths."""
    maps, fleets = (_shown(outcomes, several=several) for several in (False, True))
    drawn: dict[str, Callable[[], Figure]] = {
        "truth": partial(draw_truth, maps[0][1], runner),
        "maps": partial(draw_maps, maps),
        "differences": partial(draw_differences, maps, runner),
        "fleet_maps": partial(draw_maps, fleets),
        "fleet_differences": partial(draw_differences, fleets, runner),
    }
    folder.mkdir(parents=True, exist_ok=True)
    with mpl.rc_context(STYLE):
        for name, picture in drawn.items():
            figure = picture()
            figure.savefig(folder / f"{name}.png", dpi=DPI)
            plt.close(figure)
    return [folder / f"{name}.png" for name in drawn]


def _shown(outcomes: Outcomes, *, several: bool) -> list[Titled]:
    """Maps to show: per configuration of one machine the paper's, then ours; or fleets."""
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
    return resistance_class(layers["resistance"]), slope_class(layers["grade_east"], layers["grade_north"])


def _rgb(classes: Ints, palette: Floats, unknown: AnyArray | tuple[float, ...] = UNKNOWN_RGB) -> Floats:
    """Colours (rows, columns, 3)."""
    out: Floats = np.where((classes == UNKNOWN)[..., None], unknown, palette[np.maximum(classes, 0)])
    return out


def _image(axes: Axes, rgb: Floats) -> None:
    rows, columns = rgb.shape[:2]
    axes.imshow(rgb, origin="lower", extent=(0.0, columns * CELL_M, 0.0, rows * CELL_M), interpolation="nearest")


def _grid(count: int, rows: int) -> tuple[Figure, Any]:
    """A figure with `count` columns of maps."""
    size = (PANEL_IN * count, 2.6 * rows + 0.8)
    return plt.subplots(rows, count, figsize=size, squeeze=False, sharex=True, sharey=True)


def _finish(figure: Figure, panels: Any, handles: Sequence[Any], title: str) -> Figure:
    for axes in panels[-1]:
        axes.set_xlabel("east [m]")
    for axes in panels[:, 0]:
        axes.set_ylabel("north [m]")
    figure.legend(handles=list(handles), loc="outside lower center", ncols=len(handles))
    figure.suptitle(title, x=0.01, ha="left", fontsize=10, weight="bold")
    return figure


def _head(axes: Axes, text: str, size: float) -> None:
    axes.set_title(text, loc="left", fontsize=size, weight="bold")


def _key(*more: Patch) -> list[Patch]:
    zones = [Patch(color=rgb, label=f"{z.name} {z.c_rr:g}") for rgb, z in zip(ZONE_RGB, ZONES, strict=True)]
    slope = Patch(color=tuple(GRADE_RGB[SLOPE]), label="slope, 15 degrees; flat is green")
    return [*zones, slope, *more]


def draw_truth(outcome: MapOutcome, runner: Runner) -> Figure:
    """True maps of resistance and grade."""
    figure, panels = _grid(2, 1)
    classes = _classes(true_layers(scene(outcome.drive, runner.cache).truth))
    parts = zip(panels[0], classes, (ZONE_RGB, GRADE_RGB), ("rolling resistance", "grade"), strict=True)
    for axes, kind, palette, name in parts:
        _image(axes, _rgb(kind, palette))
        _head(axes, name, 10)
    figure.set_size_inches(2.2 * PANEL_IN + 2, 4.2)
    return _finish(figure, panels, _key(), "Ground truth")


def draw_maps(maps: Sequence[Titled]) -> Figure:
    """Plotted maps: resistance above, grade below."""
    figure, panels = _grid(len(maps), 2)
    for column, (title, outcome, kind) in zip(panels.T, maps, strict=True):
        for axes, classes, palette in zip(
            column, _classes(outcome.made.layers_of(kind)), (ZONE_RGB, GRADE_RGB), strict=True
        ):
            _image(axes, _rgb(classes, palette))
        _head(column[0], title, 8)
    return _finish(figure, panels, _key(Patch(color=UNKNOWN_RGB, label="not known")), _seed("Plotted maps", maps))


def draw_differences(maps: Sequence[Titled], runner: Runner) -> Figure:
    """Wrong cells in white; J over all plotted cells, as in the paper."""
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
        _head(column[0], title, 8)
    wrong = Patch(facecolor=WRONG_RGB, edgecolor="black", label="wrong class")
    handles = [wrong, Patch(color=BEHIND_RGB, label="not known")]
    return _finish(figure, panels, handles, _seed("Difference from the truth: resistance above, grade below", maps))


def _seed(title: str, maps: Sequence[Titled]) -> str:
    return f"{title}; seed {maps[0][1].drive.seed}"
