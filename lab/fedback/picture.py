"""A picture: the ellipse of a machine that finds its lane shrinks as it takes a bend."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Ellipse

from agents.localisation.filters.state import YAW
from agents.localisation.lanes.lane_map import METRES, LaneMap
from lab.fedback.maps import days_ago, lane_map
from lab.fedback.nodes import Nodes
from lab.fedback.rerun import Course, rerun
from protocol.arrays import Floats, Ints
from protocol.site.geometry import BLOCK_CELLS

SIGMAS_95 = 2.448  # of an ellipse that holds 95 % of a normal distribution in the plane
SHOWN_S, EVERY_S = 44, 4  # how much of a drive is drawn, an ellipse so often
MARGIN_M = 8.0
WITH, WITHOUT = "#0072b2", "#d55e00"


def draw(first: Mapping[str, Nodes], second: Mapping[str, Nodes], file: Path) -> None:
    """Draw the bend of the second day in which the lanes of the first tell a machine most."""
    lanes = lane_map(days_ago([(name, nodes.rows) for name, nodes in first.items()], 1))
    courses = [(n, rerun(n, lambda _: None, aids=False), rerun(n, lambda _: lanes)) for n in second.values()]
    nodes, without, aided = max(courses, key=lambda of: _fall(of[0], of[2]).max())
    at = int(np.argmax(_fall(nodes, aided)))
    shown = np.arange(max(at - SHOWN_S // 2, 0), min(at + SHOWN_S // 2, len(nodes.stamp_ns)))
    figure, (plan, sizes) = plt.subplots(1, 2, figsize=(10, 4.6), width_ratios=(3, 2), layout="constrained")
    _plan(plan, lanes, nodes, (without, aided), shown)
    for course, colour, label in ((without, WITHOUT, "without"), (aided, WITH, "on the fleet's lanes")):
        sizes.plot(shown - at, SIGMAS_95 * _std_m(course)[shown], color=colour, label=label)
    sizes.set(xlabel="time [s]", ylabel="larger half axis of the 95 % ellipse [m]", ylim=(0, None))
    sizes.legend(frameon=False)
    figure.savefig(file, dpi=110)
    plt.close(figure)


def _std_m(course: Course) -> Floats:
    std_m: Floats = np.sqrt(np.linalg.eigvalsh(course.live_m2)[:, -1])
    return std_m


def _fall(nodes: Nodes, course: Course) -> Floats:
    """By how much the larger half axis falls over ten seconds around each node, 0 where the machine does not turn."""
    turned = np.abs(np.roll(nodes.x[:, YAW], -5) - np.roll(nodes.x[:, YAW], 5)) % (2 * np.pi) > 1.0
    std_m = _std_m(course)
    fall: Floats = np.where(turned, np.roll(std_m, 5) - np.roll(std_m, -5), 0.0)
    fall[:100] = fall[-SHOWN_S:] = 0.0
    return fall


def _plan(axes: Axes, lanes: LaneMap, nodes: Nodes, courses: tuple[Course, Course], shown: Ints) -> None:
    """Lanes, the true way, and ellipses every few seconds."""
    for (x, y), tile in lanes.tiles.items():
        metres = METRES[tile.metres].sum(axis=0).reshape(BLOCK_CELLS, BLOCK_CELLS)
        west, south = x * BLOCK_CELLS, y * BLOCK_CELLS
        extent = (west, west + BLOCK_CELLS, south, south + BLOCK_CELLS)
        axes.imshow(metres, cmap="Greys", vmin=0, vmax=12, extent=extent, origin="lower")
    axes.plot(*nodes.true_m[shown].T, color="black", lw=1)
    for course, colour in zip(courses, (WITHOUT, WITH), strict=True):
        for k in shown[::EVERY_S].tolist():
            values, vectors = np.linalg.eigh(course.live_m2[k])
            angle = float(np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1])))
            width, height = (2 * SIGMAS_95 * np.sqrt(values[::-1])).tolist()
            middle = nodes.true_m[k] + course.live_m[k]
            axes.add_patch(Ellipse(tuple(middle), width, height, angle=angle, fill=False, color=colour, lw=1.2))
    low, high = nodes.true_m[shown].min(axis=0) - MARGIN_M, nodes.true_m[shown].max(axis=0) + MARGIN_M
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xlabel="east [m]", ylabel="north [m]")
