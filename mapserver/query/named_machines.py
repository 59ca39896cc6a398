"""Machines by name: mass and speed from their newest samples, followed on demand in the journal."""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mapserver.evidence.fold_config import name_hash
from mapserver.journal.rows import Selection
from mapserver.query.source import MapSource, MapState
from protocol.arrays import Table
from protocol.errors import QueryError, Refusal, StoreError
from protocol.machine.readings import MAX_STAMP_NS
from protocol.queries.routing import LOADER, MACHINES, NamedMachine, RouteMachine
from protocol.units import HOUR_NS, MINUTE_NS

LOOK_BACK_NS = HOUR_NS  # time before the query's; older masses say nothing
SLOT_NS = 10 * MINUTE_NS  # span of one remembered fastest sample
PACE_MPS = 1.0  # slower machines only stood about
MOST_SHOWN = 8  # names listed in a refusal


@dataclass(frozen=True)
class Seen:
    """A machine's samples in a slot: newest known mass, or NaN; fastest speed."""

    stamp_ns: int
    mass_kg: float
    fastest_mps: float

    def joined(self, other: Seen) -> Seen:
        """Combine both."""
        newer = max((one for one in (self, other) if not math.isnan(one.mass_kg)), key=_stamp, default=self)
        return Seen(newer.stamp_ns, newer.mass_kg, max(self.fastest_mps, other.fastest_mps))


class _Followed:
    """Seen machines, by hash of name and slot."""

    def __init__(self, store: str = "") -> None:
        self.store, self.row = store, 0
        self.slots: dict[tuple[int, int], Seen] = {}

    def add(self, samples: Table, names: NDArray[np.uint64]) -> None:
        keys = np.stack([names, (samples["stamp_ns"] // SLOT_NS).astype(np.uint64)], axis=1)
        unique, of_sample = np.unique(keys, axis=0, return_inverse=True)
        for i, (name, slot) in enumerate(unique.tolist()):
            own = samples[of_sample.reshape(-1) == i]
            known = own[np.isfinite(own["mass_kg"])]
            fastest = float(np.abs(own["speed_mps"]).max())
            seen = Seen(0, math.nan, fastest)
            if len(known):
                newest = known[int(known["stamp_ns"].argmax())]
                seen = Seen(int(newest["stamp_ns"]), float(newest["mass_kg"]), fastest)
            old = self.slots.get((name, slot))
            self.slots[name, slot] = old.joined(seen) if old else seen

    def before(self, name: str, until_ns: int) -> Seen | None:
        """A machine in the hour before a time."""
        hashed, last = name_hash(name), until_ns // SLOT_NS
        slots = (self.slots.get((hashed, slot)) for slot in range(last - LOOK_BACK_NS // SLOT_NS, last + 1))
        out: Seen | None = None
        for seen in slots:
            out = out.joined(seen) if out and seen else out or seen
        return out

    def forget(self, until_ns: int) -> None:
        """Drop what is too old for this time."""
        first = until_ns // SLOT_NS - LOOK_BACK_NS // SLOT_NS
        self.slots = {key: seen for key, seen in self.slots.items() if key[1] >= first}


class NamedMachines:
    """Machines of one source. Thread-safe."""

    def __init__(self, source: MapSource) -> None:
        self._source, self._lock, self._now = source, threading.Lock(), _Followed()

    def resolve(self, machine: RouteMachine | NamedMachine, as_of_ns: int | None) -> RouteMachine:
        """A machine with all values; QueryError for an unknown name.

        Missing values are of the kind that its name begins with (`truck-3`), else of a loader.
        """
        if isinstance(machine, RouteMachine):
            return machine
        store, row, newest_ns, names = self._source.run(_state)
        if machine.name not in names:
            shown = ", ".join([*sorted(names)[:MOST_SHOWN], *(["..."] if len(names) > MOST_SHOWN else [])])
            problem = f"parameter `machine`: {machine.name!r} has sent nothing to this site"
            known = f"machines: {shown or 'none'}; kinds: {', '.join(MACHINES)}"
            raise QueryError(Refusal.OUT_OF_RANGE, f"{problem}; {known}")
        try:
            seen = self._seen(machine.name, store, row, newest_ns, as_of_ns)
        except StoreError as error:
            raise QueryError(Refusal.STORE, str(error)) from None
        kind = next((MACHINES[kind] for kind in sorted(MACHINES, key=len) if machine.name.startswith(kind)), LOADER)
        said = {}
        if seen and not math.isnan(seen.mass_kg):
            said["mass_kg"] = seen.mass_kg
        if seen and seen.fastest_mps > PACE_MPS:
            said["speed_mps"] = seen.fastest_mps
        return replace(kind, **{**said, **dict(machine.given)})

    def _seen(self, name: str, store: str, row: int, newest_ns: int, as_of_ns: int | None) -> Seen | None:
        if as_of_ns is not None:
            followed = _Followed()
            self._follow(followed, as_of_ns - LOOK_BACK_NS, as_of_ns, row)
            return followed.before(name, as_of_ns)
        with self._lock:
            if self._now.store != store or self._now.row > row:  # another store, or a restored one
                self._now = _Followed(store)
            if self._now.row < row:
                self._follow(self._now, newest_ns - LOOK_BACK_NS - SLOT_NS, MAX_STAMP_NS, row)
                self._now.forget(newest_ns)
            return self._now.before(name, newest_ns)

    def _follow(self, followed: _Followed, from_ns: int, to_ns: int, row: int) -> None:
        with self._source.location.reader() as reader:
            selection = Selection(max(0, from_ns // SLOT_NS * SLOT_NS), to_ns)
            for samples, names in self._source.past.samples(reader, selection, followed.row, row):
                followed.add(samples, names)
        followed.row = row


def _stamp(seen: Seen) -> int:
    return seen.stamp_ns


def _state(state: MapState) -> tuple[str, int, int, set[str]]:
    return state.version.store, state.version.row, state.newest_ns, set(state.machines())
