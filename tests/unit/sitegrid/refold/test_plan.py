"""Every sample is folded once whatever archives have it; differing ones are named; rows are cut."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from mapserver.journal.rows import ALL, JournalRow, Selection
from protocol.errors import SitegridError, StoreError
from sitegrid.refold.engine import Here
from sitegrid.refold.plan import Plan, _overlaps, plan
from sitegrid.refold.work import FoldTask, PartWork, fold_parts
from tests.unit.sitegrid.refold.archives import T0, S, fold_in, samples, write

pytest.importorskip("pyarrow.parquet")
ENGINE = Here(1)


def kept_of(planned: Plan) -> list[tuple[str, int, int]]:
    """Every kept sample, with repetitions."""
    return [
        (*spool, seq)
        for each in planned.contents
        for spool, intervals in each.intervals.items()
        for first, last in intervals
        for seq in range(first, last + 1)
    ]


def test_each_sample_of_a_later_part_is_compared_with_the_first_that_has_it() -> None:
    for seed in range(50):
        rng, parts, first_of, expected = np.random.default_rng(seed), [], {}, set()
        for at in range(4):
            ends = np.sort(rng.choice(12, 2 * int(rng.integers(1, 4)), replace=False)).reshape(-1, 2).tolist()
            parts.append(SimpleNamespace(intervals={"spool": [(first, last - 1) for first, last in ends]}))
            for seq in (seq for first, last in ends for seq in range(first, last)):
                if (earlier := first_of.setdefault(seq, at)) != at:
                    expected.add((at, earlier, seq))
        shared = [(at, earlier, seq) for at, earlier, _, (a, b) in _overlaps(parts) for seq in range(a, b + 1)]
        assert sorted(shared) == sorted(expected)


@pytest.mark.parametrize("seed", range(3))
def test_each_sample_is_kept_once_however_archives_overlap(seed: int, tmp_path: Path) -> None:
    """Archives that share stretches of spools, in differently cut batches."""
    rng = np.random.default_rng(seed)
    drives = {(name, spool): samples(rng, 60) for name in "ab" for spool in (1, 2**64 - 1)}
    parts, have = [], set()
    for number in range(int(rng.integers(2, 6))):
        rows: list[JournalRow] = []
        for (name, spool), drive in drives.items():
            first, end = sorted(rng.integers(0, 61, 2).tolist())
            while first < end:
                until = min(end, first + int(rng.integers(1, 20)))
                received = T0 + int(rng.integers(100)) * S
                rows.append(JournalRow(len(rows) + 1, name, spool, first + 1, drive[first:until], received))
                have |= {(name, spool, seq) for seq in range(first + 1, until + 1)}
                first = until
        if rows:
            parts.append(write(tmp_path / str(number), rows))
    planned = plan(parts, ALL, ENGINE)
    kept = kept_of(planned)
    assert len(kept) == len(set(kept))
    assert set(kept) == have
    assert sum(each.samples for each in planned.contents) == len(have) == planned.kept.total()
    again = plan(parts[::-1], ALL, ENGINE)
    assert [(c.part, c.intervals) for c in again.contents] == [(c.part, c.intervals) for c in planned.contents]
    row = 1
    for each, taken in zip(planned.contents, planned.taken, strict=True):  # the plan equals the fold
        work = PartWork(each.part, "", each.first_ns, row, each.rows, each.samples, tuple(taken.items()))
        if each.rows:
            fold_parts(FoldTask(fold_in(tmp_path / "work"), (work,), 1))
        row += each.rows


def test_a_sample_with_another_content_is_named_and_nothing_is_planned(tmp_path: Path) -> None:
    rows = samples(np.random.default_rng(1), 50)
    changed = rows.copy()
    changed["c_rr"][30] += 0.001
    one = write(tmp_path / "one", [JournalRow(1, "a", 7, 1, rows, T0)])
    other = write(tmp_path / "other", [JournalRow(1, "a", 7, 11, changed[10:40], T0 + S)])
    with pytest.raises(StoreError) as caught:
        plan([other, one], ALL, ENGINE)
    expected = f"{other}: sample 31 of a, spool {7:016x}, is another in a further archive ({one})"
    assert str(caught.value).startswith(expected)
    assert plan([one, other], Selection(without=frozenset("a")), ENGINE).kept.total() == 0


def test_a_file_that_holds_a_sample_twice_is_named(tmp_path: Path) -> None:
    rows = samples(np.random.default_rng(1), 20)
    both = [JournalRow(1, "a", 7, 1, rows, T0), JournalRow(2, "a", 7, 11, rows[10:], T0)]
    with pytest.raises(SitegridError, match="holds sample 11 of a, spool 0000000000000007, twice"):
        plan([write(tmp_path / "one", both)], ALL, ENGINE)
