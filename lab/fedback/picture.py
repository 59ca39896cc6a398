"""Picture of a machine without GPS, whose ellipse shrinks at each bend on a lane."""

from __future__ import annotations

import math
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Ellipse

from agents.localisation.lanes.lane_map import METRES, LaneMap
from lab.fedback.blackout import INSIDE, LASTS_S, Errors
from protocol.arrays import Floats
from protocol.site.geometry import BLOCK_CELLS

SIGMAS_95 = math.sqrt(INSIDE)  # semi-axes of the 95 % ellipse
EVERY_S = 20  # between ellipses
MARGIN_M, DARK_M = 12.0, 4.0  # around the route; metres driven that are drawn black
WITH, WITHOUT = "#0072b2", "#d55e00"


def draw(lanes: LaneMap, aided: Errors, without: Errors, file: Path) -> None:
    """Draw the estimated track without GPS and its ellipses."""
    figure, (plan, sizes) = plt.subplots(1, 2, figsize=(11, 4.6), width_ratios=(1, 1), layout="constrained")
    _draw_lanes(plan, lanes)
    for course, colour, label in ((without, WITHOUT, "without lanes"), (aided, WITH, "on the fleet's lanes")):
        lost = (course.after_s >= 0) & (course.after_s <= LASTS_S)
        _draw_ellipses(plan, course, np.flatnonzero(lost)[::EVERY_S].tolist(), colour)
        std_m = np.sqrt(np.linalg.eigvalsh(course.covariance_m2[lost])[:, -1])
        sizes.plot(course.after_s[lost], SIGMAS_95 * std_m, color=colour, label=f"{label}: half axis of the ellipse")
        off_m = np.hypot(*course.off_m[lost].T)
        sizes.plot(course.after_s[lost], off_m, color=colour, ls=":", label=f"{label}: error")
    way: Floats = aided.true_m[(aided.after_s >= 0) & (aided.after_s <= LASTS_S)]
    plan.plot(*way.T, color="black", lw=0.8)
    low, high = way.min(axis=0) - MARGIN_M, way.max(axis=0) + MARGIN_M
    plan.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xlabel="east [m]", ylabel="north [m]")
    sizes.set(xlabel="time without GPS [s]", ylabel="[m]", xlim=(0, LASTS_S), ylim=(0, None))
    sizes.legend(frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncol=2, fontsize="small")
    figure.savefig(file, dpi=110)
    plt.close(figure)


def _draw_lanes(axes: Axes, lanes: LaneMap) -> None:
    n = BLOCK_CELLS
    for (x, y), tile in lanes.tiles.items():
        metres = METRES[tile.metres].sum(axis=0).reshape(n, n)
        extent = (x * n, (x + 1) * n, y * n, (y + 1) * n)
        axes.imshow(metres, cmap="Greys", vmin=0, vmax=DARK_M, extent=extent, origin="lower")


def _draw_ellipses(axes: Axes, course: Errors, at: list[int], colour: str) -> None:
    for k in at:
        values, vectors = np.linalg.eigh(course.covariance_m2[k])
        angle = float(np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1])))
        width, height = (2 * SIGMAS_95 * np.sqrt(values[::-1])).tolist()
        x_m, y_m = (course.true_m[k] + course.off_m[k]).tolist()
        axes.add_patch(Ellipse((x_m, y_m), width, height, angle=angle, fill=False, color=colour, lw=1.2))
