"""The ground of a scenario: soil zones, ramps, roughness; and the terrain from it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from protocol.arrays import Bools, Floats, Ints
from protocol.config import require_between
from sim.terrain.terrain import SOILS, Terrain

FILLET_M = 2.0  # rounding length at a ramp's foot and crown
ROUGHNESS_LENGTH_M = 1.2
ROUGHNESS_STREAM = 2**32 - 1  # apart from machines, numbered from 0
UNDULATION_STREAM = 2**32 - 2
MAX_NODES = 20_000_000
# Undulation as ISO 8608 classifies roads: displacement density at N0 falls with the spatial frequency squared. Longer
# waves are out of its scope, shorter ones are roughness.
N0_PER_M, UNDULATION_PER_M = 0.1, (0.01, 0.1)

Point = tuple[float, float]


@dataclass(frozen=True)
class ZoneConfig:
    """Polygon of one soil. outline: corners in `map` [m]."""

    soil: str
    outline: tuple[Point, ...]

    def __post_init__(self) -> None:
        soil_index(self.soil)
        if len(self.outline) < 3:
            raise ValueError(f"outline: {len(self.outline)} corners are no area")


@dataclass(frozen=True)
class RampConfig:
    """Plane slope from foot to top, as wide as the site, level beyond."""

    foot_m: Point
    top_m: Point
    rise_m: float

    def __post_init__(self) -> None:
        if not np.hypot(*self.run_m) > 0:
            raise ValueError("foot_m, top_m: the same place")
        if abs(self.rise_m) > np.hypot(*self.run_m):
            raise ValueError(f"rise_m: {self.rise_m:g} m over {np.hypot(*self.run_m):.1f} m is steeper than 45 degrees")

    @property
    def run_m(self) -> Floats:
        """From foot to top (2,)."""
        run: Floats = np.array(self.top_m) - np.array(self.foot_m)
        return run


@dataclass(frozen=True)
class GroundConfig:
    """Rectangle north-east of the origin of `map`. soil: outside zones; later zones cover earlier ones.

    cell_m: of heights and zones. roughness_m: standard deviation. undulation_cm3: displacement density at 0.1 cycles/m
    of waves of 10 to 100 m, ISO 8608 (1024: middle of class D), the same for each seed.
    """

    width_m: float
    depth_m: float
    soil: str
    cell_m: float = 0.25
    roughness_m: float = 0.01
    zone: tuple[ZoneConfig, ...] = ()
    ramp: tuple[RampConfig, ...] = ()
    undulation_cm3: float = 0.0

    def __post_init__(self) -> None:
        soil_index(self.soil)
        require_between(self, 10, 1e5, "width_m", "depth_m")
        require_between(self, 0.05, 5, "cell_m")
        require_between(self, 0, 0.1, "roughness_m")
        require_between(self, 0, 16384, "undulation_cm3")
        if self.width_m * self.depth_m / self.cell_m**2 > MAX_NODES:
            raise ValueError(f"cell_m: {self.cell_m:g} m is too fine for so large a site, over {MAX_NODES} nodes")

    def contains(self, points_m: Floats, margin_m: float) -> Bools:
        """Whether points (k, 2) are on the site, margin_m from its edges, (k,)."""
        inside = (points_m >= margin_m) & (points_m <= np.array([self.width_m, self.depth_m]) - margin_m)
        return np.logical_and(inside[:, 0], inside[:, 1])


def soil_index(name: str) -> int:
    """Index into `soil.SOILS`; ValueError with the known names."""
    names = [soil.name for soil in SOILS]
    if name not in names:
        raise ValueError(f"soil: {name!r} is none of {', '.join(names)}")
    return names.index(name)


def build_terrain(ground: GroundConfig, seed: int) -> Terrain:
    """Build the terrain; roughness is drawn from the seed."""
    rows, columns = round(ground.depth_m / ground.cell_m), round(ground.width_m / ground.cell_m)
    heights = _profile(ground, rows, columns)
    if ground.roughness_m:
        heights += _unevenness(ground, heights.shape, seed)
    if ground.undulation_cm3:
        heights += _undulation(ground, heights.shape)
    zones = np.full((rows, columns), soil_index(ground.soil), np.int64)
    terrain = Terrain(heights, ground.cell_m, zones, ground.cell_m)
    for zone in ground.zone:
        terrain = with_zone(terrain, zone)
    return terrain


def with_zone(terrain: Terrain, zone: ZoneConfig) -> Terrain:
    """The terrain with one more zone on top."""
    zones = terrain.zones.astype(np.uint8)
    corners = np.round(np.array(zone.outline) / terrain.zone_cell_m).astype(np.int32)
    cv2.fillPoly(zones, [corners], soil_index(zone.soil))
    paved: Ints = zones.astype(np.int64)
    return replace(terrain, zones=paved)


def _profile(ground: GroundConfig, rows: int, columns: int) -> Floats:
    """Heights (rows + 1, columns + 1) of all ramps, foot and crown rounded."""
    x, y = np.meshgrid(np.arange(columns + 1) * ground.cell_m, np.arange(rows + 1) * ground.cell_m)
    heights: Floats = np.zeros_like(x)
    for ramp in ground.ramp:
        length = float(np.hypot(*ramp.run_m))
        east, north = ramp.run_m / length
        along = (x - ramp.foot_m[0]) * east + (y - ramp.foot_m[1]) * north
        # running mean of the clipped distance, by its antiderivative
        ahead, behind = (_area(along + side * FILLET_M / 2, length) for side in (1, -1))
        heights += ramp.rise_m / length * (ahead - behind) / FILLET_M
    return heights


def _area(distance: Floats, length: float) -> Floats:
    """Antiderivative of min(max(distance, 0), length)."""
    inside = np.clip(distance, 0, length)
    area: Floats = 0.5 * inside**2 + length * np.maximum(distance - length, 0)
    return area


def _unevenness(ground: GroundConfig, shape: tuple[int, ...], seed: int) -> Floats:
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(ROUGHNESS_STREAM,)))
    blur = ROUGHNESS_LENGTH_M / ground.cell_m
    uneven = np.asarray(cv2.GaussianBlur(rng.standard_normal(shape), (0, 0), blur), np.float64)
    rough: Floats = uneven * (ground.roughness_m / uneven.std())
    return rough


def _undulation(ground: GroundConfig, shape: tuple[int, ...]) -> Floats:
    """Isotropic waves whose profile along any line has the one-sided density G(n) = G0 (n / N0)^-2 [m3].

    A plane density C / k^3 [m4], k = |(kx, ky)|, integrates over ky to 2 C / kx^2, and C = G0 N0^2 / 4.
    """
    rng = np.random.default_rng(np.random.SeedSequence(0, spawn_key=(UNDULATION_STREAM,)))
    along, across = np.fft.rfftfreq(shape[1], ground.cell_m), np.fft.fftfreq(shape[0], ground.cell_m)
    k = np.hypot(along, across[:, None])
    is_long = (k >= UNDULATION_PER_M[0]) & (k <= UNDULATION_PER_M[1])
    density_m4 = np.zeros_like(k)
    density_m4[is_long] = ground.undulation_cm3 * 1e-6 * N0_PER_M**2 / 4 / k[is_long] ** 3
    waves = np.fft.rfft2(rng.standard_normal(shape)) * np.sqrt(density_m4) / ground.cell_m
    heights: Floats = np.fft.irfft2(waves, shape)
    return heights
