"""What a spool's mark says of its runs, and what is gone where the file does not reach it.

A mark has, by run, the last seq that was recorded and the last that was acknowledged.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

_ACKNOWLEDGED = " acknowledged"  # after the name of a run


@dataclass(frozen=True)
class RunEnd:
    """How far a run went: the last seq recorded, and the last acknowledged."""

    spool_id: int
    recorded: int
    acknowledged: int

    def values(self) -> dict[str, int]:
        """As a mark has it."""
        name = f"{self.spool_id:016x}"
        return {name: self.recorded, name + _ACKNOWLEDGED: self.acknowledged}


def run_ends(mark: Mapping[str, int]) -> list[RunEnd]:
    """Undo `RunEnd.values`: the runs in the order in which they began."""
    names = [name for name in mark if not name.endswith(_ACKNOWLEDGED)]
    return [RunEnd(int(name, 16), mark[name], mark.get(name + _ACKNOWLEDGED, 0)) for name in names]


def runs_cut_short(there: Iterable[RunEnd], mark: Mapping[str, int]) -> list[tuple[RunEnd, int]]:
    """Runs that went further than the file says, each with how many of its samples are gone.

    there: the file's runs, in order. Only its last one can be short, and those after it are not there at all.
    """
    *earlier, last = [*there] or [RunEnd(0, 0, 0)]
    known = {run.spool_id for run in earlier}
    short = []
    for end in run_ends(mark):
        kept = last.recorded if end.spool_id == last.spool_id else 0
        gone = end.recorded - max(kept, end.acknowledged)
        if end.spool_id not in known and gone > 0:
            short.append((end, gone))
    return short
