"""A window of what the machine drove, laid over the lanes: one measurement of its place.

At the end of a window the place on the map is q = p + m + l n, of the machine's place p, the map's offset m and how far
l it keeps to the left n of the fleet's lanes; its covariance is P = L L^T. d_j is the way from there back to place j of
the window, by dead reckoning. On a grid of shifts s, which reaches over GRID_SIGMA deviations of q,

    log w(s) = SHARPNESS mean_j log(B_j(q + s + d_j) + FLOOR max_s B_j + FLOOR_M) - |L^-1 s|^2 / 2

B_j: metres that the fleet drove in the direction that the machine has at j. Ground that nobody drove is flat by the
floor, and one pass is weak. In units u = L^-1 s, w has mean mu and covariance V over that of the grid without lanes.
Along an eigenvector e of value v, what turns the prior into w is a measurement of variance v / (1 - v) at
mu e / (1 - v). A measurement moves the mean by sqrt(1 - v) as a rule. Where w rises steadily, as where lanes begin, mu
is far more, and v about 1: no more than FAR_SIGMA of that counts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from agents.localisation.lanes.lane_map import LaneMap, sectors_of
from protocol.arrays import Floats

GRID_SIGMA = 3.0
MOST_NODES = 60  # of the grid, to each side of each axis, two to a cell
SHARPNESS = 6.0  # as if so many places of a window knew of each other's error nothing
FLOOR, FLOOR_M = 0.1, 1.0
MAP_STD_M = 1.0  # what lanes are off within a window: drivers wander, and the map's own places err
FLAT = 0.98  # a window that leaves more of the variance in every direction tells nothing
FAR_SIGMA = 3.0  # lanes so far away are others; along one direction, of what a window may move the place by
LEAST_SHARE, MOST_SHARE = 0.01, 0.999  # of the variance that is left along an eigenvector


@dataclass(frozen=True)
class Match:
    """What a window shows of the place on the map: position (2,) and covariance (2, 2) [m, m2]."""

    place_m: Floats
    covariance_m2: Floats


def match(lanes: LaneMap, place_m: Floats, P: Floats, back_m: Floats, heading_rad: Floats) -> Match | str:
    """Where on the map a window ended, or why that is not to be seen: `far` or `flat`.

    place_m (2,), P (2, 2): as believed. back_m (j, 2): way from there to the places of the window, in `map`;
    heading_rad (j,): there.
    """
    step_m = lanes.cell_m / 2
    reach = np.ceil(GRID_SIGMA * np.sqrt(P.diagonal()) / step_m).astype(int).clip(1, MOST_NODES)
    shift_m = np.stack(np.meshgrid(*(np.arange(-n, n + 1) * step_m for n in reach)), axis=-1).reshape(-1, 2)
    L = np.linalg.cholesky(P)
    u = np.linalg.solve(L, shift_m.T).T
    log_prior = -0.5 * (u**2).sum(axis=1)
    _, bare = moments(log_prior, u)
    driven = _driven(lanes, (place_m + back_m) / step_m, heading_rad, reach).reshape(len(back_m), -1)
    floor = FLOOR * driven.max(axis=1, keepdims=True) + FLOOR_M
    mean, V = moments(SHARPNESS * np.log(driven + floor).mean(axis=0) + log_prior, u)
    if mean @ mean > FAR_SIGMA**2:
        return "far"
    values, vectors = np.linalg.eigh(2 * V / bare.trace())
    if values[0] > FLAT:
        return "flat"
    along = L @ vectors  # (2, 2), a column for each eigenvector
    off, variance = shown_by(vectors.T @ mean, values, (along**2).sum(axis=0))
    return Match(place_m + along @ off, (along * variance) @ along.T)


def shown_by(mean: Floats, left: Floats, variance_m2: Floats) -> tuple[Floats, Floats]:
    """What turned a prior into mean and variance (k,), both in its deviations: a measurement's offset and variance.

    variance_m2 (k,): of the prior.
    """
    left = np.clip(left, LEAST_SHARE, MOST_SHARE)
    most = FAR_SIGMA * np.sqrt(1 - left)
    return np.clip(mean, -most, most) / (1 - left), left / (1 - left) + MAP_STD_M**2 / variance_m2


def _driven(lanes: LaneMap, centre: Floats, heading_rad: Floats, reach: Floats) -> Floats:
    """Metres driven (j, rows, columns) on the grid around each place (j, 2), in half cells.

    The grid has two nodes to a cell, so of the map drawn as finely it is four rectangles, weighed by where between
    nodes a place lies.
    """
    fine = centre - 1.0  # the first cell's centre lies half a cell from its corner
    whole = np.floor(fine).astype(np.int64)
    share = fine - whole
    west, south = np.floor_divide(whole.min(axis=0) - reach, 2).tolist()
    east, north = (np.floor_divide(whole.max(axis=0) + reach + 1, 2) + 2).tolist()
    sectors, of_sector = np.unique(sectors_of(heading_rad), return_inverse=True)
    drawn = _doubled(lanes.patch(west, south, east, north, sectors))
    columns, rows = 2 * reach + 1
    out = np.empty((len(centre), rows, columns))
    first = whole - reach - 2 * np.array([west, south])
    for j, ((x, y), (tx, ty), sector) in enumerate(
        zip(first.tolist(), share.tolist(), of_sector.tolist(), strict=True)
    ):
        part = drawn[sector, y : y + rows + 1, x : x + columns + 1]
        level = (1 - tx) * part[:, :-1] + tx * part[:, 1:]
        out[j] = (1 - ty) * level[:-1] + ty * level[1:]
    return out


def _doubled(patch: Floats) -> Floats:
    """Values of cells (k, rows, columns) with those halfway between their centres (k, 2 rows - 1, 2 columns - 1)."""
    sectors, rows, columns = patch.shape
    out = np.empty((sectors, 2 * rows - 1, 2 * columns - 1))
    out[:, ::2, ::2] = patch
    out[:, 1::2, ::2] = (patch[:, 1:] + patch[:, :-1]) / 2
    out[:, :, 1::2] = (out[:, :, 2::2] + out[:, :, :-2:2]) / 2
    return out


def moments(log_w: Floats, u: Floats) -> tuple[Floats, Floats]:
    """Mean (k,) and covariance (k, k) of weights (n,), given as logarithms, at places u (n, k)."""
    w = np.exp(log_w - log_w.max())
    w /= w.sum()
    mean = w @ u
    off = u - mean
    return mean, (off.T * w) @ off
