"""Plan of a fold: every sample once, in parts ordered independently of file names.

Folds merge if they share no sample. A sample in two parts is removed from the later one, after checking that both are
bit-identical.
"""

from __future__ import annotations

from bisect import bisect_left, insort
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from mapserver.journal.rows import Selection, SpoolKey, Watermark
from protocol.arrays import Table
from protocol.errors import ConfigError, StoreError
from protocol.machine.samples import RAW_SAMPLE
from sitegrid.refold.engine import Engine
from sitegrid.refold.parts import Contents, Interval, LookTask, Part, by_spool, look


@dataclass(frozen=True)
class Plan:
    """contents: of all parts, in order. taken: per part, samples already in an earlier one."""

    contents: tuple[Contents, ...]
    taken: tuple[dict[SpoolKey, tuple[Interval, ...]], ...]
    selection: Selection

    @property
    def excluded(self) -> Counter[str]:
        """Omitted samples by reason."""
        reasons = Counter(machine=0, time=0, twice=0)
        for each in self.contents:
            reasons.update(each.excluded)
        return reasons

    @property
    def kept(self) -> Counter[SpoolKey]:
        """Kept samples by spool."""
        counts: Counter[SpoolKey] = Counter()
        for each in self.contents:
            for spool, intervals in each.intervals.items():
                counts[spool] += sum(last - first + 1 for first, last in intervals)
        return counts

    def watermarks(self, reached: Iterable[tuple[SpoolKey, int]]) -> dict[SpoolKey, Watermark]:
        """The new store's watermarks: machines continue, omitted samples count as lost.

        reached: spools' last numbers from stores, whose rows may be unread.
        """
        seqs: Counter[SpoolKey] = Counter()
        newest_ns: Counter[SpoolKey] = Counter()
        for spool, seq in [*reached, *(pair for each in self.contents for pair in each.reached.items())]:
            seqs[spool] = max(seqs[spool], seq)
        for spool, stamp_ns in (pair for each in self.contents for pair in each.newest_ns.items()):
            newest_ns[spool] = max(newest_ns[spool], stamp_ns)
        kept = self.kept
        return {spool: Watermark(seq, seq - kept[spool], newest_ns[spool]) for spool, seq in seqs.items()}


@dataclass(frozen=True)
class Comparison:
    """Task: compare samples that two parts share."""

    part: Part
    earlier: Part
    overlaps: tuple[tuple[SpoolKey, Interval], ...]


def plan(parts: Sequence[Part], selection: Selection, engine: Engine) -> Plan:
    """Survey all parts; StoreError if a sample has different contents in two."""
    contents = engine.each(look, [LookTask(part, selection) for part in parts])
    _require_one_site(contents)
    contents.sort(key=lambda each: (each.first_ns, each.origin.machines, each.origin.identity, str(each.part)))
    overlaps = list(_overlaps(contents))
    engine.each(compare, list(_comparisons(contents, overlaps)))
    taken: list[dict[SpoolKey, tuple[Interval, ...]]] = [{} for _ in contents]
    for at, _, spool, interval in overlaps:
        taken[at][spool] = (*taken[at].get(spool, ()), interval)
    again = [at for at, some in enumerate(taken) if some]
    looked = engine.each(look, [LookTask(contents[at].part, selection, taken[at]) for at in again])
    for at, each in zip(again, looked, strict=True):
        contents[at] = each
    return Plan(tuple(contents), tuple(taken), selection)


def _require_one_site(contents: Sequence[Contents]) -> None:
    first = contents[0]
    for each in contents:
        if (each.origin.name, each.origin.frame) != (first.origin.name, first.origin.frame):
            problem = f"is of site {each.origin.name!r}, frame {each.origin.frame}, but {first.part} of "
            problem += f"{first.origin.name!r}, {first.origin.frame}; fold them apart"
            raise ConfigError(each.part, problem)


def compare(task: Comparison) -> None:
    """StoreError naming the sample, unless both parts have equal bytes."""
    wanted: dict[SpoolKey, list[Interval]] = defaultdict(list)
    for spool, interval in task.overlaps:
        wanted[spool].append(interval)
    ours, others = (_samples(part, wanted) for part in (task.part, task.earlier))
    for (machine, spool_id), intervals in wanted.items():
        for first, last in intervals:
            one, other = ours[machine, spool_id, first], others[machine, spool_id, first]
            if len(differing := np.flatnonzero(one != other)):
                seq = first + int(differing[0])
                problem = f"sample {seq} of {machine}, spool {spool_id:016x}, is another in a further archive"
                advice = f"({task.earlier}); find out which is right, and leave the other out"
                raise StoreError(task.part, f"{problem} {advice}")
            if len(one) <= last - first:
                raise StoreError(task.part, "has changed while it was read; fold again")


def _samples(part: Part, wanted: dict[SpoolKey, list[Interval]]) -> dict[tuple[str, int, int], Table]:
    """Interval samples as bytes in number order, by spool and first number."""
    tables_of: dict[tuple[str, int, int], list[tuple[int, Table]]] = defaultdict(list)
    for rows in part.read():
        raw = rows.samples.view(RAW_SAMPLE)
        for spool, seqs, of_spool in by_spool(rows):
            for first, last in wanted.get(spool, ()):
                if len(inside := of_spool[(seqs >= first) & (seqs <= last)]):
                    tables_of[(*spool, first)].append((int(seqs[(seqs >= first) & (seqs <= last)][0]), raw[inside]))
    return {
        key: np.concatenate([table for _, table in sorted(tables, key=lambda pair: pair[0])])
        for key, tables in tables_of.items()
    }


def _overlaps(contents: Sequence[Contents]) -> Iterator[tuple[int, int, SpoolKey, Interval]]:
    """Samples shared with an earlier part: indices of both parts, spool, interval."""
    held: defaultdict[SpoolKey, list[tuple[int, int, int]]] = defaultdict(list)  # first, last, part; disjoint, sorted
    for at, each in enumerate(contents):
        for spool, intervals in each.intervals.items():
            before = held[spool]
            fresh: list[Interval] = []
            for first, last in intervals:
                begin = first
                near = max(0, bisect_left(before, (first, 0, 0)) - 1)
                for old_first, old_last, earlier in before[near:]:
                    if old_first > last:
                        break
                    if old_last < begin:
                        continue
                    if begin < old_first:
                        fresh.append((begin, old_first - 1))
                    yield at, earlier, spool, (max(begin, old_first), min(last, old_last))
                    begin = old_last + 1
                if begin <= last:
                    fresh.append((begin, last))
            for interval in fresh:
                insort(before, (*interval, at))


def _comparisons(
    contents: Sequence[Contents], overlaps: Iterable[tuple[int, int, SpoolKey, Interval]]
) -> Iterator[Comparison]:
    """Pairs of parts to compare; a file named twice equals itself."""
    pairs: dict[tuple[int, int], list[tuple[SpoolKey, Interval]]] = defaultdict(list)
    for at, earlier, spool, interval in overlaps:
        if contents[at].origin.identity != contents[earlier].origin.identity:
            pairs[at, earlier].append((spool, interval))
    for (at, earlier), some in pairs.items():
        yield Comparison(contents[at].part, contents[earlier].part, tuple(some))
