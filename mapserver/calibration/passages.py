"""Stays of a machine by time, and what lies between: rises from cell to cell, bends of the slope.

Measured values; the sources of evidence weigh them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np

from mapserver.calibration import stays as st
from mapserver.calibration.ledger import CELL_M, EPOCH_SLOTS
from protocol.arrays import AnyArray, Bools, Floats, Ints, Table

MOST_SAMPLES = 4000  # samples per stay: no machine takes more in 10 s, and larger sums overflowed
MAX_PAUSE_S = 15.0  # a longer pause interrupts the sequence
GAP_M = 1.5  # metres between stays without samples, of unknown slope
JUMP_M = 2.0  # metres between positions and odometry, plus half the distance


@dataclass(frozen=True)
class Passages:
    """Stays (n,) of all machines, by machine and time.

    epoch, machine, cell: indices. direction: +1, -1. c_rr: NaN if unknown. along, across: slopes ahead and to the left.
    ahead: unit vector (n, 2). place_m: (n, 2) in `map`. driven_m: that samples stand for. follows: continues the stay
    before.
    """

    machine: Ints
    epoch: Ints
    cell: Ints
    direction: Floats
    c_rr: Floats
    along: Floats
    across: Floats
    ahead: Floats
    place_m: Floats
    time_s: Floats
    speed_mps: Floats
    driven_m: Floats
    follows: Bools

    def __len__(self) -> int:
        return len(self.cell)


@dataclass(frozen=True)
class Epochs:
    """Epochs (e,) by machine. number: in EPOCH_NS since 1970."""

    machine: Ints
    number: Ints


def sound(table: Table) -> Table:
    """Drop stays that no machine can have made."""
    return table[(table["n"] <= MOST_SAMPLES) & (table["n"] > 0)]


def passages(ledgers: Mapping[str, Table]) -> tuple[Passages, Epochs, Ints]:
    """Stays by machine (sorted names), epochs, and the cell numbers of indices."""
    parts, epochs, numbers = [], [], []
    count = 0
    for index, name in enumerate(sorted(ledgers)):
        table = sound(ledgers[name])
        own, which = np.unique(st.slot(table["key"]) // EPOCH_SLOTS, return_inverse=True)
        parts.append(_in_order(table, index, which + count))
        epochs.append(np.full(len(own), index))
        numbers.append(own)
        count += len(own)
    cells, index_of = np.unique(np.concatenate([part.cell for part in parts]), return_inverse=True)
    joined = {f.name: np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(Passages)}
    joined["cell"] = index_of
    return Passages(**joined), Epochs(np.concatenate(epochs), np.concatenate(numbers)), cells


def _in_order(table: Table, machine: int, epoch: Ints) -> Passages:
    """cell: its number, not an index."""
    slot = st.slot(table["key"])
    sums = {name: table[name].astype(np.float64) for name in st.MEASURED}
    start_s = (slot - slot.min(initial=0)) * (st.SLOT_NS * 1e-9)
    time_s = start_s + sums["time"] / sums["n"] / st.PLACE_UNITS
    order = np.lexsort((table["key"], time_s))
    cells, direction = st.cell(table["key"])[order], st.direction(table["key"])[order]
    time_s = time_s[order]
    begins = np.ones(len(order), np.bool_)  # rejoins stays that the end of a slot cut
    begins[1:] = (np.diff(cells) != 0) | (np.diff(direction) != 0) | (np.diff(time_s) > MAX_PAUSE_S)
    first = np.flatnonzero(begins)
    counted_s = np.add.reduceat(time_s * sums["n"][order], first) if len(first) else time_s
    sums = {name: np.add.reduceat(values[order], first) if len(first) else values for name, values in sums.items()}
    n, cells, ahead_or_back = sums["n"], cells[first], direction[first].astype(np.float64)
    time_s = counted_s / n
    ahead = np.stack([sums["cosine"], sums["sine"]], axis=1)
    ahead /= np.maximum(np.hypot(*ahead.T), 1e-9)[:, None]
    gradient = np.stack([sums["east"], sums["north"]], axis=1) / (n * st.VALUE_UNITS)[:, None]
    place = np.stack([sums["x"], sums["y"]], axis=1) / (n * st.PLACE_UNITS)[:, None]
    with np.errstate(invalid="ignore"):
        c_rr = sums["c_rr"] / (sums["known"] * st.VALUE_UNITS)
    return Passages(
        machine=np.full(len(first), machine),
        epoch=epoch[order][first],
        cell=cells,
        direction=ahead_or_back,
        c_rr=c_rr,
        along=(gradient * ahead).sum(axis=1),
        across=gradient[:, 1] * ahead[:, 0] - gradient[:, 0] * ahead[:, 1],
        ahead=ahead,
        place_m=np.stack(st.column_row(cells), axis=1) * CELL_M + place,
        time_s=time_s,
        speed_mps=sums["speed"] / (n * st.PLACE_UNITS),
        driven_m=sums["distance"] / st.PLACE_UNITS,
        follows=_follows(time_s, ahead_or_back),
    )


def _follows(time_s: Floats, direction: Floats) -> Bools:
    out = np.zeros(len(time_s), np.bool_)
    out[1:] = (np.diff(time_s) < MAX_PAUSE_S) & (direction[1:] == direction[:-1])
    return out


class Links(NamedTuple):
    """Measured rises (n,) from cell to cell. per_zero_m: per bias of 1.

    bend_m: length times change of slope where samples are missing, else 0.
    """

    epoch: Ints
    start: Ints
    end: Ints
    rise_m: Floats
    per_zero_m: Floats
    slope: Floats
    bend_m: Floats


def links(p: Passages) -> Links:
    """Trapezoids of the slope between successive stays.

    By positions, horizontal like a slope's denominator; wheels include slip and slope length.
    """
    j = np.flatnonzero(p.follows)
    j = j[p.cell[j] != p.cell[j - 1]]
    i = j - 1
    apart_m = np.hypot(*(p.place_m[j] - p.place_m[i]).T)
    gap = apart_m - (p.driven_m[i] + p.driven_m[j]) / 2 > GAP_M
    by_speed_m = (p.speed_mps[i] + p.speed_mps[j]) / 2 * (p.time_s[j] - p.time_s[i])
    drove = np.abs(apart_m - by_speed_m) < JUMP_M + by_speed_m / 2  # otherwise the position jumped
    signed_m = apart_m * p.direction[j]
    slope = (p.along[i] + p.along[j]) / 2
    bend_m = np.where(gap, apart_m * np.abs(p.along[j] - p.along[i]), 0.0)
    columns = (p.epoch[j], p.cell[i], p.cell[j], signed_m * slope, signed_m, np.abs(slope), bend_m)
    return Links(*(column[drove] for column in columns))


def grouped(*keys: AnyArray) -> tuple[Ints, Ints, Ints]:
    """Group rows by equal keys (n,): first rows, group of each row, counts."""
    order = np.lexsort(keys[::-1])
    begins = np.ones(len(order), np.bool_)
    begins[1:] = np.any([np.diff(key[order]) != 0 for key in keys], axis=0)
    group = np.empty(len(order), np.int64)
    group[order] = np.cumsum(begins) - 1
    return order[begins], group, np.bincount(group)
