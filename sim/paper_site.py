"""The paper's site as `paper/site-proposal.png` lays it out: five zones, one 15 degree slope, three haul routes.

The paper gives coefficients and slope, no dimensions: the layout is this project's proposal.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from protocol.arrays import Floats, Ints
from protocol.site import SiteConfig
from sim.routes import Route, rounded
from sim.soil import CONCRETE, DRY_DIRT, GRAVEL, SAND, WET_DIRT
from sim.terrain import Terrain

WIDTH_M, DEPTH_M = 200.0, 150.0
CELL_M = 0.25
SLOPE_FOOT_M, SLOPE_RISE_M, SLOPE_RAD = 128.0, 6.0, math.radians(15)
SLOPE_TOP_M = SLOPE_FOOT_M + SLOPE_RISE_M / math.tan(SLOPE_RAD)
FILLET_M = 1.0
ROUGHNESS_LENGTH_M = 1.2
ROUGHNESS_STREAM = 2**32 - 1  # keeps the ground's noise apart from the machines', which are numbered from 0

# Painted in this order over dry dirt.
ZONES: tuple[tuple[int, tuple[tuple[float, float], ...]], ...] = (
    (GRAVEL, ((60, 0), (200, 0), (200, 34), (128, 44), (112, 72), (58, 92), (0, 92), (0, 60), (45, 40))),
    (CONCRETE, ((0, 0), (66, 0), (62, 40), (50, 58), (0, 66))),
    (SAND, ((0, 92), (48, 92), (74, 112), (70, 150), (0, 150))),
    (WET_DIRT, ((108, 98), (136, 88), (200, 96), (200, 150), (112, 150))),
)

# Corners of closed tours. They share ground: west and east meet head-on on the haul road at x = 98, the tours over the
# slope meet on the plateau and on the way down.
TOURS: tuple[tuple[tuple[float, float], ...], ...] = (
    ((30, 16), (80, 18), (98, 36), (98, 104), (80, 128), (38, 134), (18, 116), (20, 88), (12, 62), (12, 32)),
    ((116, 24), (166, 24), (187, 42), (187, 106), (172, 128), (128, 128), (98, 104), (98, 36)),
    ((40, 76), (92, 78), (118, 62), (166, 66), (187, 84), (187, 106), (172, 128), (46, 128), (24, 112), (20, 88)),
)


def site(name: str) -> SiteConfig:
    """The site frame: the south-west corner in a gravel pit near Karlsruhe."""
    return SiteConfig(name=name, origin_lat_deg=49.01, origin_lon_deg=8.40, origin_height_m=120.0)


def terrain(seed: int, roughness_m: float) -> Terrain:
    """The ground of the site. roughness_m: standard deviation of its unevenness, drawn from the seed."""
    return Terrain(_heights(seed, roughness_m), CELL_M, _zones(), CELL_M)


def route_of(machine: int) -> Route:
    """Route of a machine: one tour each, then again from other places, every second time the other way round."""
    tour, lap = machine % len(TOURS), machine // len(TOURS)
    route = rounded(TOURS[tour]).shifted(lap * 0.618 % 1)  # the golden section spreads any number of machines
    return route.reversed() if lap % 2 else route


def _heights(seed: int, roughness_m: float) -> Floats:
    x = np.arange(round(WIDTH_M / CELL_M) + 1) * CELL_M
    profile: Floats = np.clip((x - SLOPE_FOOT_M) * math.tan(SLOPE_RAD), 0, SLOPE_RISE_M)
    k = round(FILLET_M / CELL_M)  # a running mean rounds foot and crown
    profile = np.convolve(np.pad(profile, k, "edge"), np.ones(2 * k + 1) / (2 * k + 1), "valid").astype(np.float64)
    heights: Floats = np.tile(profile, (round(DEPTH_M / CELL_M) + 1, 1))
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(ROUGHNESS_STREAM,)))
    blur = ROUGHNESS_LENGTH_M / CELL_M
    uneven = np.asarray(cv2.GaussianBlur(rng.standard_normal(heights.shape), (0, 0), blur), np.float64)
    heights += roughness_m * uneven / uneven.std()
    return heights


def _zones() -> Ints:
    zones = np.full((round(DEPTH_M / CELL_M), round(WIDTH_M / CELL_M)), DRY_DIRT, np.uint8)
    for zone, polygon in ZONES:
        cv2.fillPoly(zones, [np.round(np.array(polygon) / CELL_M).astype(np.int32)], zone)
    return zones.astype(np.int64)
