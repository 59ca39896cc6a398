"""What a machine's samples are off by, and the samples without it: one function for every map.

A sample of direction d (+1 ahead, -1 in reverse) on ground c with slope s ahead has, for a zero z and a scale error k,

    c_rr = c + d z + d k (d c + s),    slope ahead = s - z,    slope to the left = t + a

and d c_rr + slope ahead is the drive force over weight as it was measured, (1 + k) (d c + s): in it the zero cancels.
So with scale = k / (1 + k) nothing but the sample itself is needed to undo all three. Of a machine that rolls unlike
the others what is left then is c (1 + m) + b (`mapserver.calibration.rolling`), which m and b undo.

A machine that calibrates itself has taken a zero and a scale off already, and states them in each sample. Then the sum
above is (1 - applied scale) of the drive force over weight, so that what was measured follows (`measured`), and a
correction takes off the difference alone: it does not matter who calibrated when.

Only + - * / and a table of headings: kernels and machines would differ in the last bit of a sine, and so would maps.

SampleCorrections of one machine in the order of time: what covers what, and what lies at a time.
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

HEADINGS = 4096  # of the table: 0.8e-3 rad off at most, which on 15 degrees is 0.2e-3 of a slope across
_UNIT = 1 << 20  # sines are rounded to this: the last bits of a library's sine are not the same everywhere
_TURNS = np.arange(HEADINGS) * (2 * np.pi / HEADINGS)
HEADING_TABLE: Ints = np.rint(_UNIT * np.stack([np.cos(_TURNS), np.sin(_TURNS)], axis=1)).astype(np.int64)
UNIT_VECTORS: Floats = HEADING_TABLE / _UNIT  # exact: a power of two
_PER_RAD = HEADINGS / (2 * np.pi)
# Where a machine's scale is not known, its share of drive force times that error is the larger part of a sample's error
# from this share on (data sheets: 0.0045 of zero, 0.045 of scale). To take the zero alone off there would exchange one
# wrong value for another, so that samples on slopes stay as they are. NO_SHARE: of a sensor that measures no force no
# resistance is corrected at all.
NO_SHARE, LEVEL_SHARE, ANY_SHARE = 0.0, 0.1, 100.0
LAST_NS = 2**62  # a correction without an end ends then
DIGITS = 5  # a correction is rounded to 1e-5 before it is used: it is a fact, not a solver's floats
_C_LOW, _C_HIGH = LIMITS["c_rr"]
_GRADE_LOW, _GRADE_HIGH = LIMITS["grade_e"]
VALUES = ("zero", "scale", "across", "most_share", "rolls", "drags")


@dataclass(frozen=True)
class Correction:
    """What is taken off the samples of one machine, from_ns <= stamp_ns < to_ns.

    zero of the balance [-], which is also how much too low the slope ahead is; scale: k / (1 + k) of the drive force;
    across: how much too high the slope to the left is. All rounded to DIGITS. covariance (3, 3): of what is left, in
    this order. most_share: c_rr of a sample with a larger share of drive force over weight stays as it was; less than
    ANY_SHARE where the scale is not known, and then what the machine itself applied of a scale stays applied. rolls,
    drags: m and b.
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
    """Corrections of one machine, in order of time, and the same in numbers: spans (k, 2) and values (k, 6)."""

    def __init__(self, each: Iterable[Correction]) -> None:
        self.each = tuple(sorted(each, key=lambda one: one.from_ns))
        self.spans = np.array([(one.from_ns, one.to_ns) for one in self.each], np.int64).reshape(-1, 2)
        self.values = np.array([values(one) for one in self.each], np.float64).reshape(-1, len(VALUES))


class SampleCorrections:
    """Corrections of all machines as one value: equal ones change every sample alike.

    The spans of one machine do not overlap. There may be many: what is changed for one machine costs nothing for the
    others.
    """

    def __init__(self, each: Iterable[Correction] = ()) -> None:
        by_machine: dict[str, list[Correction]] = {}
        for one in each:
            by_machine.setdefault(one.machine, []).append(one)
        self._take({machine: _Spans(own) for machine, own in by_machine.items()})

    def replaced(self, machines: Mapping[str, Sequence[Correction]]) -> SampleCorrections:
        """The same but for all corrections of some machines."""
        return self._with(self._machines | {name: _Spans(each) for name, each in machines.items()})

    def without(self, machines: Collection[str]) -> SampleCorrections:
        """Those of the other machines."""
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
        self._places: dict[str, tuple[int, int]] = {}  # of each machine's: the first, and the end
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
        """A word for what they do to samples stamped before a time, which no others have; "" for nothing.

        Where a span is cut in two, it is another word, which does no harm: it says when evidence may be used again.
        """
        hashed, some = hashlib.blake2b(digest_size=8), False
        for name, own in self._machines.items():
            if early := int(np.searchsorted(own.spans[:, 0], before_ns)):
                some = True
                hashed.update(f"{name}/{early}/".encode())
                hashed.update(np.minimum(own.spans[:early], before_ns).tobytes() + own.values[:early].tobytes())
        return hashed.hexdigest() if some else ""

    def spans_of(self, machine: str) -> tuple[Correction, ...]:
        """Those of one machine, in order of time."""
        own = self._machines.get(machine)
        return own.each if own else ()

    def newest(self, machine: str) -> Correction | None:
        """The last one of a machine; None for none."""
        own = self._machines.get(machine)
        return own.each[-1] if own else None

    def applied(self, rows: Table, machines: Sequence[str], machine: Ints) -> Table:
        """Samples (n,) without their machines' errors; those that no correction covers stay bytes as they were.

        machines: names; machine (n,): index of each sample's in them. Corrections count from what was measured, so of
        them only what a sample does not state as applied is taken off; where the machine knows a scale and the
        correction does not, the machine's counts. Values leave the limits of a sample by nothing: they end there.
        """
        if not any(name in self._places for name in machines) or not len(rows):
            return rows
        places = np.array([self._places.get(name, (0, 0)) for name in machines], np.int64)
        out = rows.copy()
        _correct(out, machine, places, self._spans, self._values, UNIT_VECTORS)
        return out


UNCORRECTED = SampleCorrections()


def corrected(rows: Table, corrections: Iterable[Correction]) -> Table:
    """Samples (n,) of one machine without its errors. corrections: of this machine; see `SampleCorrections.applied`."""
    own = SampleCorrections(corrections)
    names = [one.machine for one in own.each[:1]]
    return own.applied(rows, names, np.zeros(len(rows), np.int64))


def measured(rows: Table) -> Table:
    """Samples (n,) as their machines measured them, without the calibrations that these applied; the same where none.

    Ledgers are made of these: the zero of a machine that calibrates itself would seem to step at every standstill.
    """
    applied = (rows["applied_zero"] != 0.0) | (rows["applied_scale"] != 0.0)
    if not applied.any():
        return rows
    out = corrected(rows, [Correction("", 0, LAST_NS, 0.0, 0.0, 0.0, ())])
    out["applied_zero"] = out["applied_scale"] = 0.0
    return out


@numba.njit(cache=True, nogil=True)
def heading_index(heading_rad: float) -> int:
    """Which line of the table a heading has."""
    return int(np.floor(heading_rad * _PER_RAD + 0.5)) % HEADINGS


@numba.njit(cache=True, nogil=True)
def _correct(rows: Any, machine: Any, places: Any, spans: Any, values: Any, units: Any) -> None:
    """Correct rows in place. machine (n,): index in places (m, 2), each one's first and end in the corrections.

    spans (k, 2): by machine, in order of time; values (k, 6): by VALUES.
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
    """What a correction does to a sample, by VALUES."""
    return one.zero, one.scale, one.across, one.most_share, one.rolls, one.drags


def paint(spans: list[Correction], one: Correction) -> None:
    """Put a correction over those of one machine, which are in order of time; what it covers of them goes.

    Neighbours that do the same become one, as sure as the later: else they would grow without an end.
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
    """The correction that a time has, of those of one machine in order of time."""
    index = bisect_right(spans, stamp_ns, key=lambda one: one.from_ns) - 1
    return spans[index] if index >= 0 and stamp_ns < spans[index].to_ns else None
