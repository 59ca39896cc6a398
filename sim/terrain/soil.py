"""The ground's five materials: the paper's zones, with a traction and a slip stiffness that are assumed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from protocol.site.ground_classes import ZONES


@dataclass(frozen=True)
class Soil:
    """One material [-]. traction: peak drive force over load. slip_stiffness: that force per unit of slip."""

    name: str
    c_rr: float
    traction: float
    slip_stiffness: float


CONCRETE, GRAVEL, DRY_DIRT, WET_DIRT, SAND = range(5)

_GRIP = ((0.80, 15.0), (0.60, 9.0), (0.60, 7.0), (0.45, 5.0), (0.55, 3.0))
SOILS = tuple(Soil(zone.name, zone.c_rr, *grip) for zone, grip in zip(ZONES, _GRIP, strict=True))

# Columns of the table above, to be indexed by arrays of zones.
C_RR = np.array([s.c_rr for s in SOILS])
TRACTION = np.array([s.traction for s in SOILS])
SLIP_STIFFNESS = np.array([s.slip_stiffness for s in SOILS])
