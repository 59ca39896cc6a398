"""A line on the map, cut into even steps: where it is, where it leads, and how fast its curves may be driven."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from protocol.arrays import Floats

CURVE_M = 7.0  # length over which a direction changes at a corner: about the circle that a machine turns on
REVERSAL_RAD = math.radians(120.0)  # at sharper corners than this a machine stops and drives on in reverse


@dataclass(frozen=True)
class Steps:
    """n even steps along a line.

    length_m (n,): of each; position_m (n, 2): of their middles, in `map`; direction (n, 2): unit vectors along;
    end_m (n + 1,): way from the begin to their ends.
    """

    length_m: Floats
    position_m: Floats
    direction: Floats
    end_m: Floats


def lengths(line_m: Floats) -> Floats:
    """Lengths (n - 1,) of the pieces of a line (n, 2)."""
    return np.asarray(np.hypot(*np.diff(line_m, axis=0).T))


def steps(line_m: Floats, step_m: float) -> Steps:
    """Cut a line (k, 2) of more than one place into steps as near to step_m as divide it evenly."""
    distance_m = np.concatenate([[0.0], np.cumsum(lengths(line_m))])
    n = max(1, round(distance_m[-1] / step_m))
    end_m = np.linspace(0.0, distance_m[-1], n + 1)
    ends = np.stack([np.interp(end_m, distance_m, axis) for axis in line_m.T], axis=1)
    middle_m = 0.5 * (end_m[:-1] + end_m[1:])
    position = np.stack([np.interp(middle_m, distance_m, axis) for axis in line_m.T], axis=1)
    along = np.diff(ends, axis=0)
    chord = np.hypot(*along.T)
    piece = np.clip(np.searchsorted(distance_m, middle_m, side="right") - 1, 0, len(line_m) - 2)
    own = np.diff(line_m, axis=0)[piece] / np.maximum(lengths(line_m)[piece], 1e-12)[:, None]
    # a step that turns back on itself has no chord to speak of: there the piece that it is on says where it leads
    direction = np.where((chord > 0.5 * np.diff(end_m))[:, None], along / np.maximum(chord, 1e-12)[:, None], own)
    return Steps(np.diff(end_m), position, direction, end_m)


def limits(line_m: Floats, end_m: Floats, lateral_mps2: float) -> Floats:
    """How fast (n + 1,) a line is driven at the ends of steps [m/s]: inf where it is straight, 0 where it turns back.

    On a curve of curvature k the sideways acceleration k v^2 stays below lateral_mps2. A direction changes over
    CURVE_M: the curvature is the change within half of it on both sides, over it.
    """
    distance_m = np.concatenate([[0.0], np.cumsum(lengths(line_m))])
    pieces = np.diff(line_m, axis=0)
    turn = np.diff(np.arctan2(pieces[:, 1], pieces[:, 0]))
    turn = (turn + np.pi) % (2 * np.pi) - np.pi  # (k - 2,) at the inner corners
    corner_m, reverses = distance_m[1:-1], np.abs(turn) > REVERSAL_RAD
    turned = np.concatenate([[0.0], np.cumsum(np.where(reverses, 0.0, turn))])
    first, last = (np.searchsorted(corner_m, end_m + side * CURVE_M / 2, side="right") for side in (-1, 1))
    curvature = np.abs(turned[last] - turned[first]) / CURVE_M
    limit = np.sqrt(lateral_mps2 / np.maximum(curvature, 1e-12))
    limit[curvature < 1e-9] = np.inf
    limit[np.unique(np.abs(end_m[:, None] - corner_m[reverses]).argmin(axis=0))] = 0.0
    return np.asarray(limit)
