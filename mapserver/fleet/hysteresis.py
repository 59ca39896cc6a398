"""When what the solver says replaces what counts: where it is off by more than it is unsure, twice in a row.

What the solver says changes with every sample, and old maps are to stay as people know them. In the first minutes of a
machine of which nothing counts yet, once is enough: nobody knows that map, and it is off by all of the machine's zero.
All times are site time.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from mapserver.fleet.correction import ANY_SHARE, Correction, at, values
from mapserver.fleet.ledger import EPOCH_NS, NOTHING_STATED, Stated

IN_A_ROW = 2  # solves that have to differ from what counts; one, of a new machine of which nothing counts
LEAST_ZERO, LEAST_SCALE = 0.0005, 0.005  # by less than this no map gets better
LEAST_ROLLS, TYPICAL_C_RR = 0.04, 0.04  # two deviations at best of how a machine rolls, and the ground it is judged on
FIRST_NS = 600 * 10**9  # so long after it was first seen, a machine's map is new
FROZEN_NS = 4 * 3600 * 10**9  # so long after it was first seen, an epoch keeps its zero
MOST_STEP_NS = 600 * 10**9  # of site time between two judgements: more is a jump, of a wrong clock or at night


@dataclass
class _Epoch:
    """One epoch of a machine. seen_ns: when it was first solved for; differs: how often in a row."""

    seen_ns: int
    differs: int = 0


class Hysteresis:
    """Judges what a solver says of machines, solve by solve."""

    def __init__(self) -> None:
        self._epochs: dict[str, dict[int, _Epoch]] = {}  # by machine and beginning, of its last solve
        self._watched_ns = 0  # site time without its jumps, since the first judgement
        self._judged_ns: int | None = None  # the site's now in the last one

    def watch(self, now_ns: int) -> None:
        """Note the site's now at a solve. In what was jumped over nobody learned anything."""
        self._watched_ns += min(max(now_ns - (self._judged_ns or now_ns), 0), MOST_STEP_NS)
        self._judged_ns = now_ns

    def replacing(
        self,
        machine: str,
        proposed: Sequence[Correction],
        counts: Sequence[Correction],
        stated: Mapping[int, Stated],
        *,
        asked: bool,
    ) -> list[Correction]:
        """Those of a machine that are to replace what counts.

        proposed, counts: in order of time. stated: by epoch, what the machine applied itself. asked: by a person, who
        wants all that differs at all.
        """
        known, newest_ns = self._epochs.get(machine), proposed[-1].from_ns
        # Of what counts since before this server began, an epoch is as old as it is for its machine.
        begins = known is None and len(counts) > 0
        own = self._epochs[machine] = {
            one.from_ns: (known or {}).get(one.from_ns)
            or _Epoch(self._watched_ns - (newest_ns - one.from_ns if begins else 0))
            for one in proposed
        }
        is_new = self._watched_ns < min(epoch.seen_ns for epoch in own.values()) + FIRST_NS
        needed = 1 if is_new and not counts else IN_A_ROW
        out = []
        for one in proposed:
            epoch, now = own[one.from_ns], at(counts, one.from_ns)
            applied = stated.get(one.from_ns // EPOCH_NS, NOTHING_STATED)
            epoch.differs = epoch.differs + 1 if differs(one, now, applied) else 0
            frozen = now is not None and self._watched_ns > epoch.seen_ns + FROZEN_NS
            wanted = (now is None or values(now) != values(one)) if asked else epoch.differs >= needed and not frozen
            if wanted:
                out.append(one)
        return out

    def differs_now(self, machine: str, from_ns: int) -> bool:
        """Whether the last solve differed from what counts at a beginning."""
        return self._epochs[machine][from_ns].differs > 0

    def decided(self, machine: str, corrections: Sequence[Correction]) -> None:
        """Begin to count anew what was decided."""
        for from_ns, epoch in self._epochs.get(machine, {}).items():
            if any(one.from_ns <= from_ns < one.to_ns for one in corrections):
                epoch.differs = 0


def differs(one: Correction, counts: Correction | None, stated: Stated = NOTHING_STATED) -> bool:
    """Whether a correction differs from what is taken off now by more than it is unsure, and by enough to be seen.

    counts: None where samples stay as they were sent, with what the machine applied itself. Where the correction does
    not know the scale, that stays applied.
    """
    if counts:
        zero, scale, across = (abs(a - b) for a, b in zip(values(one)[:3], values(counts)[:3], strict=True))
    else:
        zero, across = math.hypot(one.zero - stated.zero, stated.zero_std), abs(one.across)
        scale = math.hypot(one.scale - stated.scale, stated.scale_std) if one.most_share >= ANY_SHARE else 0.0
    before = counts.rolls + counts.drags / TYPICAL_C_RR if counts else 0.0
    zero_std, scale_std, across_std = (math.sqrt(one.covariance[i][i]) for i in range(3))
    return (
        zero > max(zero_std, LEAST_ZERO)
        or scale > max(scale_std, LEAST_SCALE)
        or across > max(across_std, LEAST_ZERO)
        or abs(one.rolls + one.drags / TYPICAL_C_RR - before) > LEAST_ROLLS
        or (counts is not None and one.most_share != counts.most_share)
    )
