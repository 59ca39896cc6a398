"""Snapshots: the grid as of one journal row, so that a restart folds only the tail.

A snapshot is a cache, never the truth: one that is damaged, of another schema or of other parameters is passed over,
and the journal is folded again.
"""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from mapserver.evidence import cells as ev
from mapserver.evidence.fold_config import STD_FLOOR_M, FoldConfig
from mapserver.evidence.grid import Grid
from mapserver.evidence.grid_state import GridState
from mapserver.evidence.pages import EMPTY, CompactPages
from protocol.arrays import AnyArray
from protocol.files import PRIVATE, whole_file

_NAME = re.compile(r"snapshot-(\d+)\.npz")
KEEP = 2
NO_FACTS: Mapping[str, object] = {}
_TOTALS = ("folded", "skipped", "newest_ns", "oldest_ns")
log = logging.getLogger("mapserver.evidence.snapshot")


def save(
    folder: Path, row: int, state: GridState, cell_m: float, config: FoldConfig, facts: Mapping[str, object] = NO_FACTS
) -> Path:
    """Write a snapshot that is true for journal row `row`, and remove all but the newest two.

    facts: plain values of all else that it depends on; see `parameters`. Raises OSError.
    """
    path = folder / f"snapshot-{row}.npz"
    for part in folder.glob(".snapshot-*.part"):  # of a process that was killed: one alone writes to a store
        part.unlink(missing_ok=True)
    totals = {name: getattr(state, name) for name in _TOTALS}
    header = {**parameters(cell_m, config, facts), "row": row, **totals}
    with whole_file(path, PRIVATE) as file:
        np.savez(file, header=np.array(json.dumps(header)), **_arrays(state.blocks))  # type: ignore[arg-type]
    for old in rows_on_disk(folder)[KEEP:]:
        (folder / f"snapshot-{old}.npz").unlink(missing_ok=True)
    return path


def rows_on_disk(folder: Path) -> list[int]:
    """Journal rows of the snapshots in a folder, newest first."""
    matches = (_NAME.fullmatch(path.name) for path in folder.glob("snapshot-*.npz"))
    return sorted((int(m.group(1)) for m in matches if m), reverse=True)


def remove_beyond(folder: Path, last_row: int) -> None:
    """Remove snapshots that the journal does not reach: once it grew past them they would pass for true.

    They are left where the journal was restored from a backup, or lost its end.
    """
    for row in rows_on_disk(folder):
        if row > last_row:
            log.warning("snapshot removed row=%d problem='the journal ends at row %d'", row, last_row)
            (folder / f"snapshot-{row}.npz").unlink(missing_ok=True)


def load(
    path: Path, cell_m: float, config: FoldConfig, facts: Mapping[str, object] = NO_FACTS
) -> tuple[int, Grid] | None:
    """Return the row and the grid of a snapshot, or None if it is damaged or was made with other parameters."""
    try:
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
            header = json.loads(str(file["header"]))
            expected = parameters(cell_m, config, facts)
            if {key: header.get(key) for key in expected} != expected:
                return None
            state = GridState(_blocks(file), *(header[name] for name in _TOTALS))
            if path.name != f"snapshot-{header['row']}.npz":
                raise ValueError(f"it is true for row {header['row']}")
            return header["row"], Grid.from_state(cell_m, config, state)
    except Exception as error:  # zipfile and numpy answer damage with a dozen kinds of error
        log.warning("snapshot passed over path=%s error=%r", path, str(error))
        return None


def load_newest(
    folder: Path, last_row: int, cell_m: float, config: FoldConfig, facts: Mapping[str, object] = NO_FACTS
) -> tuple[int, Grid]:
    """Return the newest usable snapshot that the journal reaches, or row 0 and an empty grid."""
    for row in rows_on_disk(folder):
        if row <= last_row and (loaded := load(folder / f"snapshot-{row}.npz", cell_m, config, facts)):
            return loaded
    return 0, Grid(cell_m, config)


def parameters(cell_m: float, config: FoldConfig, facts: Mapping[str, object]) -> dict[str, object]:
    """What the evidence depends on beside the samples: its form, the fold, and the facts about machines.

    A snapshot or a checkpoint made with others is not used. facts: plain values.
    """
    fold = {**asdict(config), "std_floor_m": STD_FLOOR_M}
    bins = [ev.RESISTANCE_BINS, ev.GRADE_BINS, ev.SECTORS]
    return {"schema": ev.SCHEMA, "cell_m": cell_m, "bins": bins, **facts, **fold}


def _arrays(blocks: Sequence[tuple[int, int, CompactPages]]) -> dict[str, AnyArray]:
    """Blocks as few long arrays: place and lengths (n, 2 + parts) of each, and its parts end to end."""
    parts = [[getattr(pages, name) for _, _, pages in blocks] for name in CompactPages.__slots__]
    places = [(x, y) for x, y, _ in blocks]
    lengths = [[len(part) for part in of_one] for of_one in zip(*parts, strict=True)]
    table = np.array([(*place, *of_one) for place, of_one in zip(places, lengths, strict=True)], np.int64)
    joined = {
        name: np.concatenate([getattr(EMPTY, name), *part])
        for name, part in zip(CompactPages.__slots__, parts, strict=True)
    }
    return {"blocks": table.reshape(-1, 2 + len(parts)), **joined}


def _blocks(file: Mapping[str, AnyArray]) -> tuple[tuple[int, int, CompactPages], ...]:
    """Undo `_arrays`; pages are copies, so that those which grow give their memory back. ValueError for no pages."""
    table, parts = file["blocks"], [file[name] for name in CompactPages.__slots__]
    if (table[:, 2:] < 0).any() or table[:, 2:].sum(axis=0).tolist() != [len(part) for part in parts]:
        raise ValueError("parts of other lengths than its blocks say")
    for part, name in zip(parts, CompactPages.__slots__, strict=True):
        if part.dtype != getattr(EMPTY, name).dtype or part.shape[1:] != getattr(EMPTY, name).shape[1:]:
            raise ValueError(f"{name} of another kind")
    blocks, starts = [], [0] * len(parts)
    for x, y, *lengths in table.tolist():
        ends = [start + length for start, length in zip(starts, lengths, strict=True)]
        pages = CompactPages(*(part[i:j].copy() for part, i, j in zip(parts, starts, ends, strict=True)))
        if not pages.is_sound:
            raise ValueError(f"pages that cannot be, of block {x}, {y}")
        blocks.append((x, y, pages))
        starts = ends
    return tuple(blocks)
