"""Makes a checkpoint in small steps, from the nearest earlier one and the samples it lacks.

Only touched blocks are merged, others are copied. Time depends on the new samples, memory stays small.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from mapserver.evidence.grid import Grid
from mapserver.evidence.grid_state import GridState
from mapserver.evidence.pages import Record
from mapserver.evidence.timeline import Block
from mapserver.journal.facts import Facts
from mapserver.journal.journal import JournalReader
from mapserver.journal.rows import Selection
from mapserver.past.checkpoint_file import Checkpoint, CheckpointWriter, DamagedError, Header
from mapserver.past.checkpoints import Checkpoints
from mapserver.past.past import StorePast
from protocol.files import PRIVATE, whole_file

FOLDED_AT_ONCE = 32_768  # samples per step, 30 ms
MERGED_AT_ONCE = 32  # blocks per step, 10 ms
SPILL_SAMPLES = 1_000_000  # samples whose folds take 50 MB, which then move to disk
SPILL_FILE = "spill"


def make(past: StorePast, reader: JournalReader, closed_ns: int, facts: Facts) -> Iterator[None]:
    """Make the checkpoint of a full hour, with these facts, step by step.

    It covers the journal's rows at the first step. Cancelled, it leaves nothing. Raises OSError, and StoreError if
    journal, archive or base is damaged; the base is then ignored.
    """
    before = past.depends_on(reader, facts)
    header = Header(closed_ns, reader.last_row, before(closed_ns))
    base = past.checkpoints.nearest(closed_ns, before, header.row)
    spill = past.checkpoints.folder / SPILL_FILE
    try:
        part, waiting = Grid(past.cell_m, past.config, FOLDED_AT_ONCE), 0
        selection = Selection.by(facts, to_ns=closed_ns - 1)
        for samples, names in past.lacking(reader, base.header if base else None, selection, header.row):
            part.fold_all(samples, names)
            waiting += len(samples)
            yield
            if waiting >= SPILL_SAMPLES:
                yield from _write(spill, base, part, header)
                base = _reopened(base, spill)
                part, waiting = Grid(past.cell_m, past.config, FOLDED_AT_ONCE), 0
        yield from _write(past.checkpoints.path(closed_ns), base, part, header)
    except DamagedError as error:
        if base:
            past.checkpoints.pass_over(base, error)
        raise
    finally:
        if base:
            base.close()
        spill.unlink(missing_ok=True)


def remove_unfinished(checkpoints: Checkpoints) -> None:
    """Remove a killed process's files; raises OSError. None may be in the making."""
    for left in (checkpoints.folder / SPILL_FILE, *checkpoints.folder.glob(".*.part")):
        left.unlink(missing_ok=True)


def _reopened(base: Checkpoint | None, path: Path) -> Checkpoint:
    if base:
        base.close()
    return Checkpoint(path)


def _write(path: Path, base: Checkpoint | None, part: Grid, header: Header) -> Iterator[None]:
    """Write a checkpoint plus a grid, step by step."""
    state = part.state()
    fresh = {(x, y): record for x, y, record in state.blocks}
    numbers = _numbers(base)
    places = sorted(fresh.keys() | numbers.keys())
    path.parent.mkdir(exist_ok=True)
    with whole_file(path, PRIVATE) as file:
        writer = CheckpointWriter(file)
        for first in range(0, len(places), MERGED_AT_ONCE):
            some = places[first : first + MERGED_AT_ONCE]
            merged = _merged(base, numbers, part, {place: fresh[place] for place in some if place in fresh})
            for place in some:
                if place in merged:
                    writer.add(*place, merged[place])
                elif base:
                    writer.copy(base, np.array([numbers[place]]))
            yield
        sums = Grid.from_state(part.cell_m, part.config, (base.header if base else header).state)
        sums.merge(Grid.from_state(part.cell_m, part.config, replace(state, blocks=())))
        writer.finish(header.with_totals(sums.state()))


def _numbers(base: Checkpoint | None) -> dict[Block, int]:
    """Number of each block in a checkpoint."""
    if base is None:
        return {}
    places = zip(base.index["x"].tolist(), base.index["y"].tolist(), strict=True)
    return {place: number for number, place in enumerate(places)}


def _merged(
    base: Checkpoint | None, numbers: Mapping[Block, int], part: Grid, fresh: Mapping[Block, Record]
) -> dict[Block, Record]:
    """Merge blocks with those of a checkpoint."""
    both = sorted(numbers[place] for place in fresh if place in numbers)
    if base is None or not both:
        return dict(fresh)
    grids = (
        Grid.from_state(part.cell_m, part.config, GridState(tuple(blocks), 0, 0, 0, 0))
        for blocks in (base.blocks(np.array(both)), ((*place, record) for place, record in fresh.items()))
    )
    merged, more = grids
    merged.merge(more)
    return {(x, y): record for x, y, record in merged.state().blocks}
