"""The sources of evidence, as equations of bias, scale and lateral bias.

Signs as in `correction.py`; z per epoch, k and a per machine, m and b of those that roll differently (`rolling.py`):

- `same_ground`: c_rr of a cell is the same for all machines and directions.
- `crossings`: so is its gradient, measured in each machine's frame.
- `heights`: a closed loop climbs nothing; links between cells rise as measured plus z.
- `edges`: c_rr does not change with slope. An apparent change is k ds, or common to all slopes, which ascents and
  descents tell apart.
- `known_ground`: the site states c_rr.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp

from mapserver.calibration.equations import Equations, equations, sparse, stacked
from mapserver.calibration.passages import Links, Passages, grouped, links
from mapserver.calibration.tuning import CalibrationTuning
from protocol.arrays import AnyArray, Floats, Ints

SAME_GROUND, CROSSINGS, HEIGHTS, EDGES, KNOWN_GROUND = "same_ground", "crossings", "heights", "edges", "known_ground"

LEAST_C_RR = 0.002  # lower bound of c_rr in the share of drive force
SECTORS = 8  # headings per turn
EDGE_SECTORS = 4


class Parameters(NamedTuple):
    """Indices of z, k, a, the common effect of slopes, m, b. unlike: sorted, machines that roll differently."""

    epochs: int
    machines: int
    unlike: tuple[int, ...] = ()

    @property
    def size(self) -> int:
        """Number of parameters."""
        return self.ramps + 1 + 2 * len(self.unlike)

    @property
    def zeros(self) -> slice:
        """Indices of all z."""
        return slice(0, self.epochs)

    @property
    def scales(self) -> slice:
        """Indices of all k."""
        return slice(self.epochs, self.epochs + self.machines)

    @property
    def lateral(self) -> slice:
        """Indices of all a."""
        return slice(self.epochs + self.machines, self.epochs + 2 * self.machines)

    @property
    def ramps(self) -> int:
        """Index of the growth of c_rr with slope, everywhere."""
        return self.epochs + 2 * self.machines

    @property
    def rolls(self) -> slice:
        """Indices of all m, relative."""
        return slice(self.ramps + 1, self.ramps + 1 + len(self.unlike))

    @property
    def drags(self) -> slice:
        """Indices of all b [c_rr]."""
        return slice(self.rolls.stop, self.size)


@dataclass(frozen=True)
class GroundState:
    """Ground by cell: c_rr (n,), gradient (n, 2); NaN if unknown."""

    c_rr: Floats
    gradient: Floats


class Means(NamedTuple):
    """Means (n,) by epoch, cell, direction and sector."""

    epoch: Ints
    machine: Ints
    cell: Ints
    direction: Floats
    ahead: Floats
    c_rr: Floats
    along: Floats
    across: Floats
    c_std: Floats
    slope_std: Floats


def first_ground(p: Passages, cells: int) -> GroundState:
    """Mean measured ground."""
    known = np.isfinite(p.c_rr)
    with np.errstate(invalid="ignore"):
        count = np.bincount(p.cell[known], minlength=cells)
        c_rr = np.bincount(p.cell[known], p.c_rr[known], cells) / count
        stays = np.bincount(p.cell, minlength=cells)
        east, north = (np.bincount(p.cell, part, cells) / stays for part in gradients(p).T)
    return GroundState(c_rr, np.stack([east, north], axis=1))


def gradients(p: Passages) -> Floats:
    """Measured gradients (n, 2), east and north."""
    left = np.stack([-p.ahead[:, 1], p.ahead[:, 0]], axis=1)
    out: Floats = p.along[:, None] * p.ahead + p.across[:, None] * left
    return out


def means(p: Passages, tuning: CalibrationTuning) -> Means:
    """Average stays, so that ground, not passages, limits the size."""
    sector = _sector(p.ahead, SECTORS)
    first, group, count = grouped(p.epoch, p.cell, sector * 2 + (p.direction > 0))
    known = np.isfinite(p.c_rr)
    known_count = np.bincount(group[known], minlength=len(first))
    with np.errstate(invalid="ignore"):
        c_rr = np.bincount(group[known], p.c_rr[known], len(first)) / known_count
    along, across, east, north = (mean(values, group, count) for values in (p.along, p.across, *p.ahead.T))
    c_std = np.hypot(tuning.c_std, tuning.c_share * np.abs(c_rr)) * repeated(np.maximum(known_count, 1), tuning.same)
    slope_std = np.hypot(tuning.slope_std, tuning.slope_share * np.hypot(along, across)) * repeated(count, tuning.same)
    ahead = np.stack([east, north], axis=1)
    where = p.epoch[first], p.machine[first], p.cell[first], p.direction[first]
    return Means(*where, ahead, c_rr, along, across, c_std, slope_std)


def _sector(ahead: Floats, sectors: int) -> Ints:
    turns = np.arctan2(ahead[:, 1], ahead[:, 0]) / (2 * np.pi)
    return np.floor(turns * sectors + 0.5).astype(np.int64) % sectors


def mean(values: Floats, group: Ints, count: Ints) -> Floats:
    """Mean of each group."""
    return np.asarray(np.bincount(group, values, len(count)) / count, np.float64)


def repeated(count: AnyArray, same: float) -> Floats:
    """Factor of a standard deviation after passages; same: their common share of variance."""
    return np.sqrt((1 - same) / count + same)


def same_ground(
    m: Means, layout: Parameters, ground: GroundState, known: Floats, place: Ints | None = None
) -> Equations:
    """c_i = c (1 + m) + b + d z + d k (d c + s), with d c + s from the ground so far.

    A stay's own noise would correlate with the scale. known (cells,): NaN without stated c_rr; others are another
    source. place: group of equal c, if not the cell.
    """
    at = np.flatnonzero(np.isfinite(m.c_rr) & ~np.isfinite(known[m.cell]))
    places, count = (m.cell, len(known)) if place is None else (place, place.max(initial=-1) + 1)
    return equations(
        _balance(m, at, layout, ground.c_rr[m.cell[at]], ground),
        sparse(len(at), count, (places[at], 1.0)),
        m.c_rr[at],
        m.c_std[at],
    )


def known_ground(
    m: Means, layout: Parameters, ground: GroundState, known: Floats, tuning: CalibrationTuning
) -> Equations:
    """As `same_ground`, with c known but for a common error per value."""
    at = np.flatnonzero(np.isfinite(m.c_rr) & np.isfinite(known[m.cell]))
    c_rr = known[m.cell[at]]
    values, which = np.unique(c_rr, return_inverse=True)
    n = len(values)
    measured = equations(
        _balance(m, at, layout, c_rr, ground), sparse(len(at), n, (which, 1.0)), m.c_rr[at] - c_rr, m.c_std[at]
    )
    stated = equations(
        sparse(n, layout.size), sparse(n, n, (np.arange(n), 1.0)), np.zeros(n), np.full(n, tuning.known_std)
    )
    return stacked(measured, stated)


def _balance(m: Means, at: Ints, layout: Parameters, c_rr: Floats, ground: GroundState) -> sp.csr_matrix:
    """Coefficients of z, k, m, b."""
    d, slope = m.direction[at], (ground.gradient[m.cell[at]] * m.ahead[at]).sum(axis=1)
    share = d * np.maximum(c_rr, LEAST_C_RR) + slope
    terms = [(m.epoch[at], d), (layout.scales.start + m.machine[at], d * share)]
    if layout.unlike:
        free = np.isin(m.machine[at], layout.unlike)
        which = np.where(free, np.searchsorted(layout.unlike, m.machine[at]), 0)
        terms += [(layout.rolls.start + which, free * c_rr), (layout.drags.start + which, free * 1.0)]
    return sparse(len(at), layout.size, *terms)


def crossings(m: Means, layout: Parameters, cells: int) -> Equations:
    """Gradient g in a machine's frame, h ahead and n left: g h = along + z, g n = across - a."""
    n, (east, north) = len(m.cell), m.ahead.T
    ahead = equations(
        sparse(n, layout.size, (m.epoch, -1.0)),
        sparse(n, 2 * cells, (m.cell, east), (cells + m.cell, north)),
        m.along,
        m.slope_std,
        blocks=2,
    )
    left = equations(
        sparse(n, layout.size, (layout.lateral.start + m.machine, 1.0)),
        sparse(n, 2 * cells, (m.cell, -north), (cells + m.cell, east)),
        m.across,
        m.slope_std,
        blocks=2,
    )
    return stacked(ahead, left)


def heights(p: Passages, layout: Parameters, cells: int, tuning: CalibrationTuning) -> Equations:
    """From cell to cell h_j - h_i = rise + z times distance, negative in reverse."""
    all_links = links(p)
    first, group, count = grouped(all_links.epoch, all_links.start * cells + all_links.end, all_links.bend_m > 0)
    measured = all_links.rise_m, all_links.per_zero_m, all_links.slope, all_links.bend_m
    rise, per_zero, slope, bend = (mean(values, group, count) for values in measured)
    link = Links._make(values[first] for values in all_links)
    n = len(first)
    link_std = np.hypot(np.hypot(tuning.rise_std_m, tuning.rise_share_m * slope), tuning.bend_share * bend)
    std = link_std * repeated(count, tuning.same)
    ground = sparse(n, cells, (link.end, 1.0), (link.start, -1.0))
    return equations(sparse(n, layout.size, (link.epoch, -per_zero)), ground, rise, std, blocks=0)


def edges(p: Passages, layout: Parameters, ground: GroundState, tuning: CalibrationTuning) -> Equations:
    """Across bends dc = d k ds + b d|s| + a step of the place, the unknown."""
    slope = (ground.gradient[p.cell] * p.ahead).sum(axis=1)
    i, j = _across_bends(p, slope, tuning)
    change, steeper = p.direction[i] * (slope[j] - slope[i]), np.abs(slope[j]) - np.abs(slope[i])
    sector = _sector(p.ahead[i], EDGE_SECTORS)
    square = np.floor((p.place_m[i] + p.place_m[j]) / 2 / tuning.place_m)
    _, place, passed = grouped(*square.T, sector, np.sign(change), p.direction[i])
    first, group, count = grouped(p.machine[i], place)
    c_rr = np.minimum(np.abs(p.c_rr[i]), np.abs(p.c_rr[j]))
    stays_std = np.sqrt(2) * np.hypot(tuning.c_std, tuning.c_share * mean(c_rr, group, count))
    std = stays_std * repeated(count, tuning.same)
    n, places = len(first), len(passed)
    scale = layout.scales.start + p.machine[i][first]
    measured = equations(
        sparse(n, layout.size, (scale, mean(change, group, count)), (layout.ramps, mean(steeper, group, count))),
        sparse(n, places, (place[first], 1.0)),
        mean(p.c_rr[j] - p.c_rr[i], group, count),
        std,
    )
    own = sparse(places, places, (np.arange(places), 1.0))
    steps = equations(sparse(places, layout.size), own, np.zeros(places), np.full(places, tuning.place_std))
    both = stacked(measured, steps)
    both.heavy[n:] = True
    return both


def _across_bends(p: Passages, slope: Floats, tuning: CalibrationTuning) -> tuple[Ints, Ints]:
    """Stays i and j, edge_m apart, on steady but different slopes."""
    apart_m = np.hypot(*np.diff(p.place_m, axis=0, prepend=p.place_m[:1]).T)
    run = np.cumsum(~p.follows)
    driven_m = np.cumsum(np.where(p.follows, apart_m, 0.0)) + run * 1e6  # separates runs
    bends = np.cumsum(p.follows & (np.abs(np.diff(slope, prepend=slope[:1])) > tuning.step))
    before = np.searchsorted(driven_m, driven_m - tuning.settle_m)
    after = np.searchsorted(driven_m, driven_m + tuning.settle_m, side="right") - 1
    usable = (bends[after] == bends[before]) & np.isfinite(p.c_rr)
    j = np.searchsorted(driven_m, driven_m + tuning.edge_m)
    i = np.flatnonzero(j < len(p))
    j = j[i]
    good = (run[i] == run[j]) & usable[i] & usable[j] & (np.abs(slope[j] - slope[i]) > tuning.bend)
    return i[good], j[good]
