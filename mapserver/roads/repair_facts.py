"""Repairs as events of the journal: which cells of a road have new ground, and since when.

Segments are named by place and may move, so an event names cells. A cell is read from evidence since its newest repair,
its age. An event without cells withdraws the repair of its segment and first pass.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterable, Mapping, Set
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from mapserver.evidence.fold_config import VISIT_NS
from mapserver.evidence.timeline import Ages, Block
from protocol.arrays import Bools, Ints
from protocol.machine.readings import MAX_STAMP_NS
from protocol.site.geometry import BLOCK_CELLS

KIND = "repair"  # event kind
MOST_BLOCKS = 4096  # of a repair; a segment of 50 m on cells of 0.1 m has some 300
DIGITS = BLOCK_CELLS**2 // 4  # hexadecimal digits of a block's cells
Cells = tuple[tuple[int, int, str], ...]  # of each block: column, row, and a bit for each cell, the first one highest
Key = tuple[str, int]
_SEGMENT = re.compile(r"-?\d{1,9}_-?\d{1,9}_[a-z](\.-?\d{1,9}'*)?", re.ASCII)


@dataclass(frozen=True)
class RoadRepair:
    """A change of a segment's ground, as in its event.

    known_ns, first_ns, seen_ns: earliest pass that it rests on, first pass after it, and its proof. before, after:
    median c_rr. cells: those of cell_m with new ground; none withdraws it. stamp_ns: site time of the decision.
    """

    segment: str
    known_ns: int
    first_ns: int
    seen_ns: int
    before: float
    after: float
    cell_m: float
    cells: Cells
    stamp_ns: int

    @property
    def key(self) -> Key:
        """Identity: a later event of the same replaces it."""
        return self.segment, self.first_ns

    def body(self) -> dict[str, Any]:
        """As plain values."""
        return asdict(self)

    @classmethod
    def from_body(cls, body: Mapping[str, Any]) -> RoadRepair:
        """Inverse of `body`; ValueError, TypeError or LookupError for foreign content."""
        repair = cls(**{**body, "cells": tuple((x, y, bits) for x, y, bits in body["cells"])})
        stamps = (0, repair.known_ns, repair.first_ns, repair.seen_ns, MAX_STAMP_NS)
        places = [place for x, y, _ in repair.cells for place in (x, y)]
        if any(type(number) is not int for number in (*stamps, repair.stamp_ns, *places)):
            raise TypeError("has a repair of fractions")
        is_sound = (
            list(stamps) == sorted(stamps)
            and repair.seen_ns <= repair.stamp_ns <= MAX_STAMP_NS
            and all(type(c_rr) is float and abs(c_rr) <= 1 for c_rr in (repair.before, repair.after))
            and 0 < repair.cell_m < math.inf
            and len({*repair.blocks}) == len(repair.cells) <= MOST_BLOCKS
            and all(abs(place) < 2**31 for place in places)
            and all(len(bits) == DIGITS and len(bytes.fromhex(bits)) == DIGITS // 2 for *_, bits in repair.cells)
            and _SEGMENT.fullmatch(repair.segment)
        )
        if not is_sound:
            raise ValueError(f"has a repair of {repair.segment!r:.40} that no road has")
        return repair

    @property
    def blocks(self) -> list[Block]:
        """Blocks with its cells."""
        return [(x, y) for x, y, _ in self.cells]


class Repairs:
    """Standing repairs, and the ages of their cells. Never changed."""

    def __init__(self, standing: Mapping[Key, RoadRepair] | None = None, ages: Ages | None = None) -> None:
        self.standing, self.ages = standing or {}, ages or {}

    def after(self, events: Iterable[RoadRepair]) -> Repairs:
        """With further events; ages of other blocks are the same objects."""
        standing, touched = dict(self.standing), set[Block]()
        for event in events:
            earlier = standing.pop(event.key, event)
            touched |= {*earlier.blocks, *event.blocks}
            if event.cells:
                standing[event.key] = event
        others = {block: age for block, age in self.ages.items() if block not in touched}
        return Repairs(standing, others | _ages(standing.values(), touched))

    def ages_as_of(self, stamp_ns: int, blocks: Collection[Block]) -> Ages:
        """Ages in blocks by the repairs that were proved by then."""
        return _ages((repair for repair in self.standing.values() if repair.seen_ns <= stamp_ns), blocks)

    def differing(self, other: Repairs) -> set[Block]:
        """Blocks whose ages may differ."""
        both = self.ages.keys() | other.ages.keys()
        return {block for block in both if self.ages.get(block) is not other.ages.get(block)}

    def judged(self, shown: Iterable[RoadRepair], again: Set[Key], since_ns: int, stamp_ns: int) -> list[RoadRepair]:
        """Events that lead to the repairs shown at a site time [ns], besides those that are shown again.

        since_ns: all passes since then were examined. Repairs that rest on earlier ones stand.
        """
        by_minute: dict[int, list[RoadRepair]] = {}
        for repair in self.standing.values():
            by_minute.setdefault(repair.first_ns // VISIT_NS, []).append(repair)
        kept, events = set(again), list[RoadRepair]()
        for one in shown:
            minute = one.first_ns // VISIT_NS
            near = (repair for at in (minute, minute - 1, minute + 1) for repair in by_minute.get(at, ()))
            same = next((repair for repair in near if _is_same(repair, one) and repair.seen_ns <= stamp_ns), None)
            kept.add((same or one).key)
            if not same:
                events.append(one)
        gone = [one for key, one in self.standing.items() if key not in kept and one.known_ns >= since_ns]
        return [*(replace(one, cells=(), stamp_ns=max(stamp_ns, one.seen_ns)) for one in gone), *events]


NO_REPAIRS = Repairs()


def cells_of(column: Ints, row: Ints) -> Cells:
    """Cells as in events."""
    blocks: dict[Block, Bools] = {}
    n = BLOCK_CELLS
    for x, y in zip(column.tolist(), row.tolist(), strict=True):
        own = blocks.setdefault((x // n, y // n), np.zeros(n * n, np.bool_))
        own[y % n * n + x % n] = True
    return tuple((*block, np.packbits(own).tobytes().hex()) for block, own in sorted(blocks.items()))


def places_of(cells: Cells) -> Ints:
    """Column and row (n, 2) of cells."""
    n, parts = BLOCK_CELLS, [np.empty((0, 2), np.int64)]
    for x, y, bits in cells:
        at = np.flatnonzero(_unpacked(bits))
        parts.append(np.stack([n * x + at % n, n * y + at // n], axis=1))
    return np.concatenate(parts)


def _unpacked(bits: str) -> Bools:
    return np.unpackbits(np.frombuffer(bytes.fromhex(bits), np.uint8)).astype(np.bool_)


def _ages(repairs: Iterable[RoadRepair], blocks: Collection[Block]) -> dict[Block, Ints]:
    """Start [ns] of the newest ground of cells (256,), of blocks with any."""
    out: dict[Block, Ints] = {}
    for repair in repairs:
        for x, y, bits in repair.cells:
            if (x, y) in blocks:
                age = out.setdefault((x, y), np.zeros(BLOCK_CELLS**2, np.int64))
                np.maximum(age, repair.first_ns, out=age, where=_unpacked(bits))
    return out


def _is_same(one: RoadRepair, other: RoadRepair) -> bool:
    """Whether they share half of the smaller one's cells: a segment's ends move, and its name with them."""
    bits, others = ({(x, y): int(own, 16) for x, y, own in repair.cells} for repair in (one, other))
    common = sum((bits[block] & others[block]).bit_count() for block in bits.keys() & others.keys())
    return 2 * common >= min(sum(own.bit_count() for own in some.values()) for some in (bits, others))
