"""Routes: machines that drive them, and what a drive costs (docs/protocol.md, "Routes")."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

from protocol.arrays import Floats

MAX_MASS_KG = 1e6
MAX_ROTATING = 2.0


@dataclass(frozen=True)
class RouteMachine:
    """A machine as a route needs it; the defaults are those of a loaded wheel loader.

    mass_kg: with what it carries. speed_mps: its highest. power_w: at the wheels. efficiency: energy at the wheels over
    that of the fuel, 0 to 1. accelerate_mps2, brake_mps2: as it is driven. lateral_mps2: sideways, in curves. rotating:
    mass with what rotates with it over mass. ValueError names a value that is not usable.
    """

    mass_kg: float = 22_000.0
    speed_mps: float = 8.0
    power_w: float = 240_000.0
    efficiency: float = 0.35
    accelerate_mps2: float = 0.8
    brake_mps2: float = 0.5
    lateral_mps2: float = 0.9
    rotating: float = 1.1

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"{field.name}: {value:g} is not positive")
        if self.mass_kg > MAX_MASS_KG:
            raise ValueError(f"mass_kg: {self.mass_kg:g} is over {MAX_MASS_KG:g}")
        if self.efficiency > 1:
            raise ValueError(f"efficiency: {self.efficiency:g} is over 1")
        if not 1 <= self.rotating <= MAX_ROTATING:
            raise ValueError(f"rotating: {self.rotating:g} is not between 1 and {MAX_ROTATING:g}")


@dataclass(frozen=True)
class RouteSteps:
    """n steps along a route, in its direction.

    way_m (n,): from the begin to the end of each; length_m; x_m, y_m: of its begin, in `map`. resistance, slope, their
    deviations and confidence: means, NaN where nothing is known of them; unknown: share of its length of which nothing
    is. energy_j: what drives the wheels; braked_j: what brakes take; time_s; speed_mps: mean.
    """

    way_m: Floats
    length_m: Floats
    x_m: Floats
    y_m: Floats
    resistance: Floats
    resistance_std: Floats
    slope: Floats
    slope_std: Floats
    confidence: Floats
    unknown: Floats
    energy_j: Floats
    braked_j: Floats
    time_s: Floats
    speed_mps: Floats


@dataclass(frozen=True)
class RouteTotals:
    """All of a route. low, high: its 90 % interval. lift_m: how much higher its end is. unknown: share of its length.

    energy_j: drive force times way. At the wheels it is more by their slip, which the map does not know: 1 to 4 % on
    firm ground, 10 % in sand. fuel_j: over the machine's efficiency.
    """

    length_m: float
    lift_m: float
    unknown: float
    energy_j: float
    energy_low_j: float
    energy_high_j: float
    braked_j: float
    fuel_j: float
    time_s: float
    time_low_s: float
    time_high_s: float
