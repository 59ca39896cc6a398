"""Pictures of calibration by the fleet: the truth and the maps before and after, and all cases in one table."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
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
from lab.fleet.cases import FleetCase
from lab.fleet.experiment import GOALS
from lab.fleet.solving import MAPS, CaseResult, JudgedMap
from lab.maps.cases import CELL_M
from protocol.arrays import Floats, Ints
from protocol.site.ground_classes import UNKNOWN, ZONES
from sitegrid.proof.figures import Report, Row, select

SHOWN = MAPS[:2]
WRONG_RGB = (1.0, 0.0, 1.0)
PALENESS = 0.2  # of the true ground behind wrong cells
COLOUR = dict(zip(MAPS, (pictures.VERMILION, pictures.BLUE, pictures.GREEN), strict=True))
LOWEST_PCT = 0.2  # bottom of the bars' scale


def draw(report: Report, results: Mapping[FleetCase, Sequence[CaseResult]], _: Runner, folder: Path) -> list[Path]:
    """Draw the table, and the maps of each case with the first seed, into a folder; returns the paths."""
    seed = report["seeds"][0]
    maps = {case.name: partial(draw_maps, case, seed, of_case[0]) for case, of_case in results.items()}
    return pictures.draw_all({"table": partial(draw_table, report), **maps}, folder)


def draw_maps(case: FleetCase, seed: int, result: CaseResult) -> Figure:
    """The true ground, and the maps before and after in the upper row; the wrong cells of those below."""
    figure, panels = plt.subplots(2, 3, figsize=(pictures.WIDTH_IN + 2, 6.4), sharex=True, sharey=True)
    true = result.maps[SHOWN[0]].true
    _image(panels[0, 0], _rgb(true))
    head(panels[0, 0], "truth")
    panels[1, 0].axis("off")
    panels[1, 0].legend(handles=_key(), loc="upper left")
    for axes, name in zip(panels[:, 1:].T, SHOWN, strict=True):
        judged = result.maps[name]
        _image(axes[0], _rgb(judged.estimated))
        head(axes[0], name)
        pale = PALENESS * np.where(judged.passed, 2.0, 1.0)
        _image(axes[1], 1 - pale[..., None] * (1 - _rgb(true)))
        north, east = (judged.passed & (judged.estimated != true)).nonzero()
        axes[1].plot((east + 0.5) * CELL_M, (north + 0.5) * CELL_M, "s", color=WRONG_RGB, ms=2.5)
        head(axes[1], f"{name}: {_percent(judged)} of the cells passed are wrong")
        axes[1].set_xlabel(EAST)
    for axes in (panels[0, 0], panels[1, 1]):
        axes.set_ylabel(NORTH)
    oracle = _percent(result.maps["oracle"])
    head(figure, f"{case.name}, seed {seed}; with the true zeros and scales {oracle} are wrong", 11)
    return figure


def _percent(judged: JudgedMap) -> str:
    wrong = judged.figures["wrong_pct"]
    return "none known" if math.isnan(wrong) else f"{wrong:.1f} %"


def _image(axes: Axes, rgb: Floats) -> None:
    lines, columns = rgb.shape[:2]
    axes.grid(visible=False)
    axes.imshow(rgb, origin="lower", extent=(0.0, columns * CELL_M, 0.0, lines * CELL_M), interpolation="nearest")


def _rgb(classes: Ints) -> Floats:
    """Colours (rows, columns, 3) of classes; what is not known is white."""
    out: Floats = np.where((classes == UNKNOWN)[..., None], 1.0, ZONE_RGB[np.maximum(classes, 0)])
    return out


def _key() -> list[Any]:
    zones = [Patch(color=rgb, label=f"{z.name} {z.c_rr:g}") for rgb, z in zip(ZONE_RGB, ZONES, strict=True)]
    return [*zones, Line2D([], [], marker="s", ls="", ms=4, color=WRONG_RGB, label="wrong class")]


def draw_table(report: Report) -> Figure:
    """Wrong cells of all cases on a logarithmic scale, single seeds as dots, and goals."""
    names = list(dict.fromkeys(row["case"] for row in report["rows"]))
    figure, axes = plt.subplots(figsize=(pictures.WIDTH_IN, 0.42 * len(names) + 1.4))
    high = 0.8 / len(MAPS)
    for place, case in enumerate(names):
        for i, name in enumerate(MAPS):
            (row,) = select(report["rows"], {"case": case, "map": name})
            _draw_bar(axes, place + (i - 1) * high, 0.9 * high, row)
    axes.set(xscale="log", xlim=(LOWEST_PCT, 100.0), ylim=(len(names) - 0.4, -0.6), xlabel="wrong cells [%]")
    axes.set_xticks([0.5, 1, 2, 5, 10, 20, 50], ["0.5", "1", "2", "5", "10", "20", "50"])
    axes.set_yticks(range(len(names)), names)
    axes.grid(visible=False, axis="y")
    handles: list[Any] = [Patch(color=colour, label=name) for name, colour in COLOUR.items()]
    handles.append(Line2D([], [], color="black", lw=2, label="goal"))
    figure.legend(handles=handles, loc="outside lower center", ncols=4)
    head(axes, f"Means over the seeds ({len(report['seeds'])}); dots: single ones")
    return figure


def _draw_bar(axes: Axes, y: float, high: float, row: Row) -> None:
    axes.barh(y, row["wrong_pct"], high, color=COLOUR[row["map"]])
    seeds = row["wrong_by_seed_pct"]
    axes.plot(seeds, np.full(len(seeds), y), ".", color="black", ms=3)
    limits = [goal.limit for goal in GOALS if goal.figure == "wrong_pct" and select([row], goal.row)]
    for limit in limits:
        axes.plot([limit, limit], [y - high, y + high], color="black", lw=2)
