"""Samples on given lines, and the roads of their map."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from mapserver.evidence.fold_config import FoldConfig
from mapserver.evidence.grid import Grid
from mapserver.roads.network import network
from mapserver.roads.segments import SegmentTable, segments
from mapserver.roads.skeleton import Skeletons
from protocol.arrays import Floats, Table
from protocol.machine.samples import empty
from protocol.site.geometry import CellWindow

STEP_M, STD_M = 0.5, 0.5
EVERYWHERE = CellWindow(-5000, -5000, 10_000, 10_000)
START_NS = 1_760_000_000_000_000_000
SPEED_MPS = 5.0


def along(corners: Iterable[tuple[float, float]]) -> Floats:
    """Points of a line, STEP_M apart."""
    line = np.array(list(corners), float)
    driven_m = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    at = np.arange(0.0, driven_m[-1], STEP_M)
    return np.stack([np.interp(at, driven_m, line[:, axis]) for axis in (0, 1)], axis=1)


def ring(centre: tuple[float, float], radius_m: float) -> Floats:
    """One lap, counter-clockwise."""
    turns = np.arange(0.0, 2 * np.pi, STEP_M / radius_m)
    return np.array(centre) + radius_m * np.stack([np.cos(turns), np.sin(turns)], axis=1)


def passes(
    line: Floats, count: int = 6, c_rr: float = 0.02, seed: int = 0, after_s: float = 0.0, mass_kg: float = 40_000.0
) -> Table:
    """Passes along a line, each slightly offset."""
    draw = np.random.default_rng(seed)
    parts = []
    ahead = np.gradient(line, axis=0)
    heading = np.arctan2(ahead[:, 1], ahead[:, 0])
    for i in range(count):
        rows = empty(len(line))
        rows["x_m"], rows["y_m"] = (line + draw.normal(0.0, 0.3, 2)).T
        rows["cov_xx_m2"] = rows["cov_yy_m2"] = STD_M**2
        rows["heading_rad"], rows["speed_mps"], rows["distance_m"] = heading, SPEED_MPS, STEP_M
        rows["c_rr"], rows["c_rr_var"] = c_rr + draw.normal(0.0, 0.001, len(line)), 1e-6
        rows["mass_kg"] = mass_kg
        begins_s = after_s + i * (len(line) * STEP_M / SPEED_MPS + 20.0)
        stamps = begins_s * 1e9 + np.arange(len(line)) * (STEP_M / SPEED_MPS * 1e9)
        rows["stamp_ns"] = START_NS + stamps.astype(np.int64)
        parts.append(rows)
    return np.concatenate(parts)


def grid_of(*machines: Table) -> Grid:
    grid = Grid(1.0, FoldConfig())
    for i, rows in enumerate(machines):
        grid.fold(rows, f"truck-{i}")
    return grid


def roads_of(grid: Grid, skeletons: Skeletons | None = None) -> SegmentTable:
    blocks = grid.blocks_in(EVERYWHERE)
    pages = dict(zip(blocks, grid.pages(blocks), strict=True))
    return segments(network((skeletons or Skeletons(1.0)).skeleton(pages)))


def roads(*machines: Table) -> SegmentTable:
    return roads_of(grid_of(*machines))
