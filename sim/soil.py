"""The ground's five materials. Rolling resistance is the paper's; traction and slip stiffness are assumed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Soil:
    """One material [-]. traction: peak drive force over load. slip_stiffness: drive force over load per unit of slip.

    colour: the paper's, red, green, blue.
    """

    name: str
    c_rr: float
    traction: float
    slip_stiffness: float
    colour: tuple[int, int, int]


CONCRETE, GRAVEL, DRY_DIRT, WET_DIRT, SAND = range(5)

SOILS = (
    Soil("concrete", 0.008, 0.80, 15.0, (0, 170, 0)),
    Soil("gravel", 0.02, 0.60, 9.0, (220, 40, 40)),
    Soil("dry dirt", 0.04, 0.60, 7.0, (30, 30, 30)),
    Soil("wet dirt", 0.06, 0.45, 5.0, (255, 220, 0)),
    Soil("sand", 0.25, 0.55, 3.0, (20, 100, 220)),
)

# Columns of the table above, to be indexed by arrays of zones.
C_RR = np.array([s.c_rr for s in SOILS])
TRACTION = np.array([s.traction for s in SOILS])
SLIP_STIFFNESS = np.array([s.slip_stiffness for s in SOILS])
