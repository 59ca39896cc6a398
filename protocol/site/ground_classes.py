"""The paper's kinds of ground: names and coefficients; colours, and classes of cells."""

import math
from dataclasses import dataclass

import numpy as np

from protocol.arrays import AnyArray, Ints

UNKNOWN = -1  # a cell without samples


@dataclass(frozen=True)
class Zone:
    """A kind of ground: rolling resistance [-], colour on maps."""

    name: str
    c_rr: float
    bgr: tuple[int, int, int]


# Dark blue to yellow in even steps of the page's ordered palette: the paper's red gravel looks like bad ground.
ZONES = (
    Zone("dry concrete", 0.008, (119, 55, 36)),
    Zone("gravel", 0.02, (134, 90, 70)),
    Zone("dry dirt", 0.04, (141, 139, 130)),
    Zone("wet dirt", 0.06, (126, 172, 170)),
    Zone("sand", 0.25, (92, 221, 251)),
)
BOUNDARIES = (0.014, 0.03, 0.05, 0.155)  # midway between neighbouring coefficients

FLAT, SLOPE = 0, 1
SLOPE_LIMIT = math.tan(math.radians(7.5))  # midway between the paper's 0 and 15 degrees


def resistance_class(values: AnyArray) -> Ints:
    """Index into ZONES, a boundary going up; UNKNOWN if not finite."""
    classes = np.digitize(np.asarray(values, np.float64), BOUNDARIES)
    return np.where(np.isfinite(values), classes, UNKNOWN).astype(np.int64)


def slope_class(east: AnyArray, north: AnyArray) -> Ints:
    """SLOPE where the gradient exceeds SLOPE_LIMIT, else FLAT; UNKNOWN if not finite."""
    gradient = np.hypot(np.asarray(east, np.float64), np.asarray(north, np.float64))
    return np.where(np.isfinite(gradient), np.where(gradient > SLOPE_LIMIT, SLOPE, FLAT), UNKNOWN).astype(np.int64)


def wrong_percent(classes: Ints, truth: Ints) -> float:
    """Share [%] of cells known in both whose class is wrong (the paper's J), or NaN."""
    known = (classes != UNKNOWN) & (truth != UNKNOWN)
    if not known.any():
        return math.nan
    return 100.0 * float(np.mean(classes[known] != truth[known]))
