"""Cases for map merging: sites, machines, passes, as in the paper and harder.

A 300 x 200 m site has five zones; machines sweep it in 1 m lanes, passes alternating along and across.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from protocol.arrays import Bools, Floats, Ints
from protocol.errors import ConfigError
from protocol.site.ground_classes import ZONES

CELL_M = 1.0
DRY_CONCRETE, GRAVEL, DRY_DIRT, WET_DIRT, SAND = range(len(ZONES))
C_RR: Floats = np.array([zone.c_rr for zone in ZONES])
STEEP = math.tan(math.radians(15))
# Gradient (east, north) [m/m] by zone.
FLAT = ((0.0, 0.0),) * 5
GENTLE = ((0.0, 0.0), (0.03, 0.0), (0.0, 0.05), (-0.06, 0.04), (0.08, -0.05))
SLOPES = ((0.0, 0.0), (STEEP, 0.0), (0.0, STEEP), (-STEEP, 0.0), (0.0, -STEEP))
PASSES_BEFORE = 4  # of `repaved`, which happens during the last


@dataclass(frozen=True)
class CaseMachine:
    """One machine. Its stated covariance is right; it does not know its gain and offset.

    first: number of its first pass; even: along the site, odd: across. std_m: position error per axis. gain: factor of
    c_rr. offset_m: of positions, east. parked: stands on dry dirt and sends.
    """

    passes: int = 1
    first: int = 0
    std_m: float = 1.3
    gain: float = 1.0
    offset_m: float = 0.0
    parked: bool = False


@dataclass(frozen=True)
class MapCase:
    """The drive, the ground, and the judged part of the map.

    gradients: by zone. passes_after: complete passes after repaving. width_m: of a road across wet dirt; only its cells
    are judged. columns, rows: site size in cells.
    """

    kind: str
    machines: tuple[CaseMachine, ...]
    gradients: Sequence[tuple[float, float]] = FLAT
    judges_grade: bool = False
    passes_after: int | None = None
    width_m: int | None = None
    columns: int = 300
    rows: int = 200

    @property
    def title(self) -> str:
        """Kind and variant."""
        parts = [self.kind]
        parts += [f"{self.passes_after} after"] if self.passes_after is not None else []
        parts += [f"{self.width_m} m"] if self.width_m is not None else []
        return ", ".join(parts)

    @property
    def name(self) -> str:
        """The title for files."""
        return self.title.replace(", ", "-").replace(" ", "_")


@dataclass(frozen=True)
class Site:
    """True ground by cell (rows, columns), row 0 in the south.

    c_rr, and c_rr_later after repaving. gradient: (rows, columns, 2), east and north. repaved, judged: masks.
    """

    c_rr: Floats
    c_rr_later: Floats
    gradient: Floats
    repaved: Bools
    judged: Bools


def build_site(case: MapCase) -> Site:
    """The site of a case."""
    zone = zones(case.columns, case.rows)
    repaved = np.zeros(zone.shape, np.bool_)
    judged = np.ones(zone.shape, np.bool_)
    if case.width_m is not None:
        zone[:] = WET_DIRT
        first = (case.rows - case.width_m) // 2
        zone[first : first + case.width_m] = DRY_CONCRETE
        judged = zone == DRY_CONCRETE
    if case.passes_after is not None:
        repaved = zone == WET_DIRT
    later = np.where(repaved, GRAVEL, zone)
    return Site(C_RR[zone], C_RR[later], np.array(case.gradients, float)[zone], repaved, judged)


def zones(columns: int, rows: int) -> Ints:
    """Zone by cell (rows, columns): two in the south, three in the north."""
    zone = np.full((rows, columns), DRY_CONCRETE)
    south, north = slice(0, rows // 2), slice(rows // 2, rows)
    zone[south, columns // 2 :] = DRY_DIRT
    zone[north, : columns // 3] = GRAVEL
    zone[north, columns // 3 : 2 * columns // 3] = SAND
    zone[north, 2 * columns // 3 :] = WET_DIRT
    return zone


def parking_place(case: MapCase) -> tuple[float, float]:
    """Parking place [m]: mid dry dirt, which a gain of 1.6 turns into wet."""
    return 0.75 * case.columns * CELL_M, 0.25 * case.rows * CELL_M


def _fleet(machines: int, passes: int) -> tuple[CaseMachine, ...]:
    return tuple(CaseMachine(passes, first) for first in range(machines))


_RTK = CaseMachine(std_m=0.05)
CASES = (
    MapCase("1x1", _fleet(1, 1)),
    MapCase("1x4", _fleet(1, 4)),
    MapCase("4x4", _fleet(4, 4)),
    MapCase("bad_machine", (*_fleet(3, 4), CaseMachine(4, 3, gain=1.6, offset_m=3.0))),
    MapCase("mixed_receivers", (_RTK, *(CaseMachine(first=first, std_m=2.5) for first in (1, 2, 3)))),
    MapCase("parked_bad_machine", (*_fleet(4, 1), CaseMachine(gain=1.6, offset_m=3.0, parked=True))),
    *(MapCase("repaved", _fleet(1, PASSES_BEFORE + after), passes_after=after) for after in (1, 2)),
    *(MapCase("narrow_road", _fleet(1, 4), width_m=width) for width in (3, 6)),
    MapCase("grade_both_ways", _fleet(1, 4), GENTLE, judges_grade=True),
    MapCase("slope_15", _fleet(1, 4), SLOPES, judges_grade=True),
)


def select(names: Sequence[str]) -> tuple[MapCase, ...]:
    """Cases of these kinds in table order; none: all. ConfigError."""
    known = list(dict.fromkeys(case.kind for case in CASES))
    if unknown := [name for name in names if name not in known]:
        raise ConfigError("--cases", f"`{unknown[0][:40]}` is not known; known: {', '.join(known)}")
    return tuple(case for case in CASES if not names or case.kind in names)
