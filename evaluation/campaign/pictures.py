"""The style of all pictures of reports, and how they are written."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import matplotlib as mpl

mpl.use("Agg")  # no screen is needed

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

WIDTH_IN, DPI = 11.0, 110
STYLE: Any = {
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.3,
    "font.size": 9,
    "legend.frameon": False,
    "savefig.bbox": "tight",
}


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
