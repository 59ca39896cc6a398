"""A scenario's picture: the plan, and below it rendered views of site and machines."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mapserver.pictures.frame import INK, Image, text
from mapserver.pictures.plotter import write_image
from sim.config import SimConfig
from sim.machines.model import MachineModel
from sim.pictures.plan import draw_plan
from sim.pictures.render import closeup, overview, render
from sim.simulator import Simulator

DRIVE_S = 20.0  # simulated time before the views
LEAST_PX, GAP_PX, CAPTION_PX = 1200, 14, 30
WIDE, TALL = 0.66, 0.37  # overview: share of the picture's width; its height over its width


def draw(config: SimConfig, path: Path) -> list[Path]:
    """Draw a scenario into one file, format by suffix; returns the files written. Raises OSError."""
    simulator = Simulator(config)
    try:
        plan = draw_plan(simulator.scenario, simulator.models, simulator.state)
        while simulator.simulated_s < DRIVE_S:
            simulator.sense()
        views = _views(simulator, max(plan.shape[1], LEAST_PX) - 2 * GAP_PX)
    finally:
        simulator.close()
    write_image(path, _below(plan, views))
    return [path]


def _views(simulator: Simulator, width: int) -> Image:
    """The whole site, and beside it one machine of each kind."""
    shown = _kinds(simulator.models)[:2]
    wide = round(WIDE * width)
    narrow, height = width - wide - GAP_PX, round(TALL * width)
    low = (height - (len(shown) - 1) * (CAPTION_PX + GAP_PX)) // len(shown)
    state = simulator.state
    near = [closeup(state, machine, simulator.models[machine], narrow, low) for machine in shown]
    cameras = [overview(simulator.terrain, wide, height), *near]
    whole, *close = render(simulator.terrain, simulator.models, state, cameras)
    names = simulator.scenario.machine_names
    after = f"after {simulator.simulated_s:g} s"
    column = [_captioned(image, f"{names[i]} {after}") for i, image in zip(shown, close, strict=True)]
    return _row([_captioned(whole, f"The site {after}, from the south-east"), _column(column)])


def _kinds(models: Sequence[MachineModel]) -> list[int]:
    return [models.index(kind) for kind in dict.fromkeys(models)]


def _captioned(image: Image, words: str) -> Image:
    framed = np.pad(image, ((CAPTION_PX, 0), (0, 0), (0, 0)), constant_values=255)
    text(framed, words, (2, CAPTION_PX - 10), INK, 0.55)
    return framed


def _row(images: Sequence[Image]) -> Image:
    height = max(image.shape[0] for image in images)
    gap = np.full((height, GAP_PX, 3), 255, np.uint8)
    padded = [np.pad(i, ((0, height - i.shape[0]), (0, 0), (0, 0)), constant_values=255) for i in images]
    return np.concatenate([part for image in padded for part in (image, gap)][:-1], axis=1)


def _column(images: Sequence[Image]) -> Image:
    gap = np.full((GAP_PX, images[0].shape[1], 3), 255, np.uint8)
    return np.concatenate([part for image in images for part in (image, gap)][:-1], axis=0)


def _below(plan: Image, views: Image) -> Image:
    width = views.shape[1] + 2 * GAP_PX
    plan = np.pad(plan, ((0, GAP_PX), (0, width - plan.shape[1]), (0, 0)), constant_values=255)
    views = np.pad(views, ((0, GAP_PX), (GAP_PX, GAP_PX), (0, 0)), constant_values=255)
    return np.concatenate([plan, views], axis=0)
