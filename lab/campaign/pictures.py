"""The style of all pictures of reports, and how they are written."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import matplotlib as mpl

mpl.use("Agg")  # no screen is needed

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from protocol.arrays import Floats
from protocol.site.ground_classes import ZONES

WIDTH_IN, DPI = 11.0, 110
STYLE: Any = {
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.3,
    "figure.constrained_layout.use": True,
    "font.size": 9,
    "legend.frameon": False,
    "savefig.bbox": "tight",
}
# Colours that also colour-blind people tell apart (Okabe and Ito).
BLUE, VERMILION, PINK, ORANGE, GREEN = "#0072B2", "#D55E00", "#CC79A7", "#E69F00", "#009E73"
ZONE_RGB: Floats = np.array([zone.bgr[::-1] for zone in ZONES]) / 255  # as in the server's pictures
EAST, NORTH = "east [m]", "north [m]"


def head(target: Axes | Figure, text: str, size: float = 10, weight: str = "bold") -> None:
    """Put a title above the left edge of a panel or of a whole figure."""
    if isinstance(target, Axes):
        target.set_title(text, loc="left", fontsize=size, weight=weight)
    else:
        target.suptitle(text, x=0.01, ha="left", fontsize=size, weight=weight)


def draw_all(pictures: Mapping[str, Callable[[], Figure]], folder: Path) -> list[Path]:
    """Draw pictures into a folder, each as NAME.png; returns their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{name}.png" for name in pictures]
    with mpl.rc_context(STYLE):
        for path, picture in zip(paths, pictures.values(), strict=True):
            figure = picture()
            figure.savefig(path, dpi=DPI)
            plt.close(figure)
    return paths
