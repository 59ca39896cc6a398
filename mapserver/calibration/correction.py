"""Errors of a machine's samples and their removal, the same for every map.

A sample in direction d (+1 ahead, -1 reverse), on ground c with slope s ahead, bias z and scale error k, has

    c_rr = c + d z + d k (d c + s),    slope ahead = s - z,    slope to the left = t + a

The sum d c_rr + slope ahead is the measured drive force over weight, (1 + k) (d c + s), without the bias. So scale = k
/ (1 + k) corrects a sample from its own values. Of a machine that rolls differently c (1 + m) + b remains
(`mapserver.calibration.rolling`), which m and b correct.

A machine that calibrates itself states the bias and scale it removed; its sum is (1 - applied scale) times the force
over weight. `measured` restores the measurement. Corrections remove only the difference, so it does not matter who
calibrated when.

Only + - * / and a heading table: processors differ in the last bit of a sine, and maps must not.
"""

from __future__ import annotations

import hashlib
from bisect import bisect_right
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numba
import numpy as np

from protocol.arrays import Floats, Ints, Table
from protocol.machine.readings import MAX_STAMP_NS
from protocol.machine.samples import LIMITS

HEADINGS = 4096  # rows of the table: 0.8e-3 rad off, 0.2e-3 of lateral slope on 15 degrees
_UNIT = 1 << 20  # sines are rounded to 1 / _UNIT, as libraries differ in their last bits
_TURNS = np.arange(HEADINGS) * (2 * np.pi / HEADINGS)
HEADING_TABLE: Ints = np.rint(_UNIT * np.stack([np.cos(_TURNS), np.sin(_TURNS)], axis=1)).astype(np.int64)
UNIT_VECTORS: Floats = HEADING_TABLE / _UNIT  # exact: a power of two
_PER_RAD = HEADINGS / (2 * np.pi)
# Share of drive force up to which samples are corrected without a known scale; beyond, the scale error exceeds the bias
# (data sheets: 0.045, 0.0045), and removing the bias alone does not help. NO_SHARE: for sensors without a force.
NO_SHARE, LEVEL_SHARE, ANY_SHARE = 0.0, 0.1, 100.0
LAST_NS = 2**62  # end of an open correction [ns]
DIGITS = 5  # decimals of a correction, which is a fact, not a solver's float
_C_LOW, _C_HIGH = LIMITS["c_rr"]
_GRADE_LOW, _GRADE_HIGH = LIMITS["grade_e"]
VALUES = ("zero", "scale", "across", "most_share", "rolls", "drags")


@dataclass(frozen=True)
class Correction:
    """What is removed from a machine's samples, from_ns <= stamp_ns < to_ns.

    zero: bias [-], added to the slope ahead. scale: k / (1 + k). across: excess of the slope to the left. covariance
    (3, 3): of their errors. most_share: samples with a larger share of drive force keep their c_rr; below ANY_SHARE the
    scale is unknown, and the machine's own stays applied. rolls, drags: m and b.
    """

    machine: str
    from_ns: int
    to_ns: int
    zero: float
    scale: float
    across: float
    covariance: tuple[tuple[float, ...], ...]
    most_share: float = ANY_SHARE
    rolls: float = 0.0
    drags: float = 0.0


class _Spans:
    """Sorted corrections of one machine, also as spans (k, 2) and values (k, 6)."""

    def __init__(self, each: Iterable[Correction]) -> None:
        self.each = tuple(sorted(each, key=lambda one: one.from_ns))
        self.spans = np.array([(one.from_ns, one.to_ns) for one in self.each], np.int64).reshape(-1, 2)
        self.values = np.array([values(one) for one in self.each], np.float64).reshape(-1, len(VALUES))


class SampleCorrections:
    """Corrections of all machines as a value: equal ones change samples alike.

    Spans of one machine do not overlap. A change costs only its machines.
    """

    def __init__(self, each: Iterable[Correction] = ()) -> None:
        by_machine: dict[str, list[Correction]] = {}
        for one in each:
            by_machine.setdefault(one.machine, []).append(one)
        self._take({machine: _Spans(own) for machine, own in by_machine.items()})

    def replaced(self, machines: Mapping[str, Sequence[Correction]]) -> SampleCorrections:
        """Replace all corrections of machines."""
        return self._with(self._machines | {name: _Spans(each) for name, each in machines.items()})

    def without(self, machines: Collection[str]) -> SampleCorrections:
        """Drop the corrections of machines."""
        return self._with({name: own for name, own in self._machines.items() if name not in machines})

    def _with(self, machines: Mapping[str, _Spans]) -> SampleCorrections:
        out = SampleCorrections()
        out._take(machines)
        return out

    def _take(self, machines: Mapping[str, _Spans]) -> None:
        self._machines = {name: machines[name] for name in sorted(machines) if machines[name].each}
        parts, first = [*self._machines.values()], 0
        self._spans = np.concatenate([np.zeros((0, 2), np.int64), *(own.spans for own in parts)])
        self._values = np.concatenate([np.zeros((0, len(VALUES))), *(own.values for own in parts)])
        self._places: dict[str, tuple[int, int]] = {}  # of each machine: first and end
        for name, own in self._machines.items():
            self._places[name] = first, (first := first + len(own.each))
        self._key = self.digest()

    @property
    def each(self) -> tuple[Correction, ...]:
        """All, by machine and time."""
        return tuple(one for own in self._machines.values() for one in own.each)

    def __len__(self) -> int:
        return len(self._spans)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, SampleCorrections) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)

    def digest(self, before_ns: int = MAX_STAMP_NS) -> str:
        """Hash of the effect on samples stamped before a time; "" for none.

        It changes when a span is split, which only costs a reuse of evidence.
        """
        hashed, some = hashlib.blake2b(digest_size=8), False
        for name, own in self._machines.items():
            if early := int(np.searchsorted(own.spans[:, 0], before_ns)):
                some = True
                hashed.update(f"{name}/{early}/".encode())
                hashed.update(np.minimum(own.spans[:early], before_ns).tobytes() + own.values[:early].tobytes())
        return hashed.hexdigest() if some else ""

    def spans_of(self, machine: str) -> tuple[Correction, ...]:
        """A machine's corrections by time."""
        own = self._machines.get(machine)
        return own.each if own else ()

    def newest(self, machine: str) -> Correction | None:
        """A machine's last correction, or None."""
        own = self._machines.get(machine)
        return own.each[-1] if own else None

    def applied(self, rows: Table, machines: Sequence[str], machine: Ints) -> Table:
        """Correct samples (n,); those outside all spans keep their bytes.

        machine (n,): index into machines. A correction counts from the measurement: what a sample states as applied is
        not removed again. Results are clipped to LIMITS.
        """
        if not any(name in self._places for name in machines) or not len(rows):
            return rows
        places = np.array([self._places.get(name, (0, 0)) for name in machines], np.int64)
        out = rows.copy()
        _correct(out, machine, places, self._spans, self._values, UNIT_VECTORS)
        return out


UNCORRECTED = SampleCorrections()


def corrected(rows: Table, corrections: Iterable[Correction]) -> Table:
    """Correct a machine's samples (n,); see `SampleCorrections.applied`."""
    own = SampleCorrections(corrections)
    names = [one.machine for one in own.each[:1]]
    return own.applied(rows, names, np.zeros(len(rows), np.int64))


def measured(rows: Table) -> Table:
    """Samples (n,) without their machines' own calibration; the same object if there is none.

    Ledgers use these, or a self-calibrating machine's bias would step at every standstill.
    """
    applied = (rows["applied_zero"] != 0.0) | (rows["applied_scale"] != 0.0)
    if not applied.any():
        return rows
    out = corrected(rows, [Correction("", 0, LAST_NS, 0.0, 0.0, 0.0, ())])
    out["applied_zero"] = out["applied_scale"] = 0.0
    return out


@numba.njit(cache=True, nogil=True)
def heading_index(heading_rad: float) -> int:
    """Row of the heading table."""
    return int(np.floor(heading_rad * _PER_RAD + 0.5)) % HEADINGS


@numba.njit(cache=True, nogil=True)
def _correct(rows: Any, machine: Any, places: Any, spans: Any, values: Any, units: Any) -> None:
    """In place. machine (n,): index into places (m, 2), first and end of its corrections.

    spans (k, 2), values (k, 6 as VALUES): by machine and time.
    """
    for i in range(len(rows)):
        row = rows[i]
        first, end = places[machine[i], 0], places[machine[i], 1]
        at = first + np.searchsorted(spans[first:end, 0], row.stamp_ns, side="right") - 1
        if at < first or row.stamp_ns >= spans[at, 1]:
            continue
        applied = np.float64(row.applied_scale)
        zero = values[at, 0] - np.float64(row.applied_zero)
        scale = values[at, 1] - applied if values[at, 3] >= ANY_SHARE else 0.0
        across = values[at, 2]
        unit = heading_index(np.float64(row.heading_rad))
        ahead_e, ahead_n = units[unit, 0], units[unit, 1]
        east, north = np.float64(row.grade_e), np.float64(row.grade_n)
        if not np.isnan(east):
            c_rr = np.float64(row.c_rr)
            if not np.isnan(c_rr):
                direction = 1.0 if row.speed_mps >= 0.0 else -1.0
                share = (direction * c_rr + (east * ahead_e + north * ahead_n)) / (1.0 - applied)
                if abs(share) <= values[at, 3]:
                    c_rr = (c_rr - direction * (zero + scale * share) - values[at, 5]) / (1.0 + values[at, 4])
                    row.c_rr = np.float32(min(max(c_rr, _C_LOW), _C_HIGH))
            row.grade_e = np.float32(min(max(east + (zero * ahead_e + across * ahead_n), _GRADE_LOW), _GRADE_HIGH))
            row.grade_n = np.float32(min(max(north + (zero * ahead_n - across * ahead_e), _GRADE_LOW), _GRADE_HIGH))


def values(one: Correction) -> tuple[float, ...]:
    """Values of a correction, as VALUES."""
    return one.zero, one.scale, one.across, one.most_share, one.rolls, one.drags


def paint(spans: list[Correction], one: Correction) -> None:
    """Insert a correction into a machine's sorted ones, over what it covers.

    Neighbours of equal effect merge, with the later covariance, or they would grow without end.
    """
    first = bisect_right(spans, one.from_ns, key=lambda other: other.to_ns)
    end = first
    while end < len(spans) and spans[end].from_ns < one.to_ns:
        end += 1
    left = [replace(other, to_ns=one.from_ns) for other in spans[first:end] if other.from_ns < one.from_ns]
    right = [replace(other, from_ns=one.to_ns) for other in spans[first:end] if other.to_ns > one.to_ns]
    before, after = spans[max(first - 1, 0) : first], spans[end : end + 1]
    joined: list[Correction] = []
    for each in [*before, *left, one, *right, *after]:
        if joined and joined[-1].to_ns == each.from_ns and values(joined[-1]) == values(each):
            joined[-1] = replace(each, from_ns=joined[-1].from_ns)
        else:
            joined.append(each)
    spans[first - len(before) : end + len(after)] = joined


def at(spans: Sequence[Correction], stamp_ns: int) -> Correction | None:
    """The correction at a time, or None; spans sorted by time."""
    index = bisect_right(spans, stamp_ns, key=lambda one: one.from_ns) - 1
    return spans[index] if index >= 0 and stamp_ns < spans[index].to_ns else None
