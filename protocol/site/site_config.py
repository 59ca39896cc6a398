"""The site: name, frame `map` (metres east and north of the origin), projection to and from WGS 84.

The frame is a transverse Mercator projection at the origin with scale 1 (docs/design.md), shared by all machines.
"""

import hashlib
import re
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np

from protocol.arrays import Floats
from protocol.config import toml_lines
from protocol.site.geometry import GridGeometry

NAME = re.compile(r"[a-z0-9][a-z0-9_-]{0,62}")
MAX_EXTENT_M = 100_000.0  # of any site
LEAST_CELL_M = 0.05  # of any map


@dataclass(frozen=True)
class KnownGround:
    """An area of known rolling resistance, for calibration. outline: corners in `map` [m]."""

    name: str
    c_rr: float
    outline: tuple[tuple[float, float], ...]

    def __post_init__(self) -> None:
        if not 0 <= self.c_rr <= 1:
            raise ValueError(f"c_rr: {self.c_rr} is not between 0 and 1")
        if len(self.outline) < 3:
            raise ValueError(f"outline: {self.name}: {len(self.outline)} corners are no area")

    def inside_m(self, x_m: float, y_m: float) -> float:
        """Distance to the outline [m], negative outside."""
        corners = np.array(self.outline)
        sides = np.roll(corners, -1, axis=0) - corners
        off = np.array([x_m, y_m]) - corners
        share = np.clip((off * sides).sum(axis=1) / np.maximum((sides**2).sum(axis=1), 1e-12), 0, 1)
        edge_m = float(np.hypot(*(off - share[:, None] * sides).T).min())
        above, next_above = off[:, 1] < 0, np.roll(off[:, 1], -1) < 0
        left = sides[:, 0] * off[:, 1] - sides[:, 1] * off[:, 0]
        crossings = (above != next_above) & ((left < 0) == next_above)
        return edge_m if crossings.sum() % 2 else -edge_m


@dataclass(frozen=True)
class SiteConfig:
    """One construction site.

    clock: "data" takes the newest accepted stamp as now, "wall" also refuses stamps beyond the wall clock. extent_m:
    bound of positions east or north. known_ground: areas of known rolling resistance.
    """

    name: str
    origin_lat_deg: float
    origin_lon_deg: float
    origin_height_m: float = 0.0
    cell_m: float = 1.0
    extent_m: float = 20_000.0
    clock: str = "data"
    clock_tolerance_s: float = 5.0
    known_ground: tuple[KnownGround, ...] = ()

    def __post_init__(self) -> None:
        if not NAME.fullmatch(self.name):
            raise ValueError(f"name: {self.name!r} is not a name (lower-case letters, digits, - and _)")
        if not (-80 <= self.origin_lat_deg <= 84 and -180 <= self.origin_lon_deg <= 180):
            raise ValueError("origin_lat_deg, origin_lon_deg: not a place on Earth between 80 S and 84 N")
        if not LEAST_CELL_M <= self.cell_m <= 100:
            raise ValueError(f"cell_m: {self.cell_m} is not between {LEAST_CELL_M} and 100")
        if not 10 <= self.extent_m <= MAX_EXTENT_M:
            raise ValueError(f"extent_m: {self.extent_m} is not between 10 and {MAX_EXTENT_M:g}")
        if self.clock not in ("data", "wall"):
            raise ValueError(f'clock: {self.clock!r} is neither "data" nor "wall"')
        if self.clock_tolerance_s < 0:
            raise ValueError("clock_tolerance_s: negative")

    @property
    def crs(self) -> str:
        """The frame as a PROJ string."""
        return (
            f"+proj=tmerc +lat_0={float(self.origin_lat_deg)!r} +lon_0={float(self.origin_lon_deg)!r} "
            "+k=1 +x_0=0 +y_0=0 +datum=WGS84 +units=m +no_defs"
        )

    @cached_property
    def frame(self) -> str:
        """Frame id of eight hex digits; batches carry it, so frames never mix."""
        return hashlib.sha256(f"{self.crs} {float(self.origin_height_m)!r}".encode()).hexdigest()[:8]

    @cached_property
    def geometry(self) -> GridGeometry:
        """The site's grid."""
        return GridGeometry(self.cell_m)


def site_toml(site: SiteConfig) -> str:
    """The site as TOML."""
    values = {item.name: getattr(site, item.name) for item in fields(site) if item.name != "known_ground"}
    areas = [
        f"{{ {', '.join(toml_lines({'name': area.name, 'c_rr': area.c_rr, 'outline': area.outline}))} }}"
        for area in site.known_ground
    ]
    return "\n".join([*toml_lines(values), f"known_ground = [{', '.join(areas)}]"]) + "\n"


class Projection:
    """WGS 84 to the site frame and back (pyproj; extra `agent`, `server` or `sim`)."""

    def __init__(self, site: SiteConfig) -> None:
        from pyproj import Proj  # not needed by the client

        self._proj: Any = Proj(site.crs)
        self._height_m = site.origin_height_m

    def to_map(self, lat_deg: float, lon_deg: float, height_m: float) -> tuple[float, float, float]:
        """Position in `map` [m]."""
        x, y = self._proj(lon_deg, lat_deg)
        return float(x), float(y), height_m - self._height_m

    def to_map_many(self, lat_deg: Floats, lon_deg: Floats) -> tuple[Floats, Floats]:
        """Positions x, y [m] of shape (...); infinite if impossible."""
        x, y = self._proj(lon_deg.ravel(), lat_deg.ravel())
        return np.asarray(x).reshape(lat_deg.shape), np.asarray(y).reshape(lat_deg.shape)

    def to_geodetic(self, x_m: float, y_m: float, z_m: float = 0.0) -> tuple[float, float, float]:
        """Latitude, longitude [deg], height [m]."""
        lon, lat = self._proj(x_m, y_m, inverse=True)
        return float(lat), float(lon), z_m + self._height_m

    def to_geodetic_many(self, x_m: Floats, y_m: Floats, z_m: Floats) -> Floats:
        """Latitude, longitude [deg], height [m] (3, ...) of positions of shape (...)."""
        lon, lat = self._proj(x_m.ravel(), y_m.ravel(), inverse=True)
        return np.stack([lat.reshape(x_m.shape), lon.reshape(x_m.shape), z_m + self._height_m])
