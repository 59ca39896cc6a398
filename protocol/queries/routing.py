"""Machines for routes: what a drive costs depends on them."""

import math
from dataclasses import dataclass, fields

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
