"""What a receiver knows at one instant, in any format."""

import math
from datetime import UTC, datetime
from typing import NamedTuple

from protocol.machine.readings import Gps, GpsVelocity

SATELLITES = 18  # used under open sky
GEOID_M = 47.0  # geoid above the ellipsoid near Karlsruhe, for receivers that state both heights
# Largest horizontal standard deviation of each fix quality [m].
QUALITIES = {"fixed": 0.05, "float": 0.5, "differential": 3.0, "autonomous": math.inf}
SEMI_MAJOR_M, ECCENTRICITY_2 = 6_378_137.0, 6.694_379_990_14e-3  # ellipsoid of WGS 84


class Baseline(NamedTuple):
    """Vector from another antenna of the machine to this one; std_rad: of its direction."""

    north_m: float
    east_m: float
    down_m: float
    std_rad: float

    @property
    def heading_rad(self) -> float:
        """Clockwise from north, 0 to 2 pi."""
        return math.atan2(self.east_m, self.north_m) % (2 * math.pi)


class Epoch(NamedTuple):
    """Instant of a receiver. fix: None without one. baseline: None without carrier phase."""

    utc_ns: int
    fix: Gps | None = None
    motion: GpsVelocity | None = None
    baseline: Baseline | None = None

    @property
    def time(self) -> datetime:
        """UTC, whole seconds."""
        return datetime.fromtimestamp(self.utc_ns // 10**9, UTC)


def quality(fix: Gps) -> str:
    """Key of QUALITIES for the stated standard deviation."""
    return next(name for name, most_m in QUALITIES.items() if fix.var_e_m2**0.5 <= most_m)


def baseline(base: Gps, rover: Gps) -> Baseline | None:
    """Baseline between simultaneous fixes; None unless both are fixed by carrier phase."""
    if quality(base) != "fixed" or quality(rover) != "fixed":
        return None
    lat = math.radians(base.lat_deg)
    flat = 1 - ECCENTRICITY_2 * math.sin(lat) ** 2
    across_m = SEMI_MAJOR_M / math.sqrt(flat)  # radii of curvature, east and north
    along_m = across_m * (1 - ECCENTRICITY_2) / flat
    north_m = math.radians(rover.lat_deg - base.lat_deg) * along_m
    east_m = math.radians(rover.lon_deg - base.lon_deg) * across_m * math.cos(lat)
    std_m = math.sqrt(base.var_e_m2 + rover.var_e_m2)
    std_rad = std_m / max(math.hypot(north_m, east_m), std_m)
    return Baseline(north_m, east_m, base.height_m - rover.height_m, std_rad)
