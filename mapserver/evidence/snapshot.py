"""Snapshots: the grid as of one journal row, so that a restart folds only the tail.

A snapshot is a cache, never the truth: one that is damaged, of another schema or of other parameters is passed over,
and the journal is folded again.
"""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from mapserver.evidence import cells as ev
from mapserver.evidence.grid import Grid, GridState, PlacedPage
from mapserver.evidence.pages import CELL, NARROW, WIDE, Page, frozen
from mapserver.evidence.votes import STD_FLOOR_M, FoldConfig
from protocol.arrays import AnyArray
from protocol.files import whole_file

_NAME = re.compile(r"snapshot-(\d+)\.npz")
KEEP = 2
_TOTALS = ("folded", "skipped", "newest_ns")
log = logging.getLogger("mapserver.evidence.snapshot")


def save(
    folder: Path, row: int, state: GridState, cell_m: float, config: FoldConfig, excluded: Collection[str] = ()
) -> Path:
    """Write a snapshot that is true for journal row `row`, and remove all but the newest two.

    excluded: machines whose rows were not folded. Raises OSError.
    """
    path = folder / f"snapshot-{row}.npz"
    for part in folder.glob(".snapshot-*.part"):  # of a process that was killed: one alone writes to a store
        part.unlink(missing_ok=True)
    totals = {name: getattr(state, name) for name in _TOTALS}
    header = {**_parameters(cell_m, config, excluded), "row": row, **totals}
    with whole_file(path) as file:
        np.savez(file, header=np.array(json.dumps(header)), **_arrays(state.pages))  # type: ignore[arg-type]
    for old in rows_on_disk(folder)[KEEP:]:
        (folder / f"snapshot-{old}.npz").unlink(missing_ok=True)
    return path


def rows_on_disk(folder: Path) -> list[int]:
    """Journal rows of the snapshots in a folder, newest first."""
    matches = (_NAME.fullmatch(path.name) for path in folder.glob("snapshot-*.npz"))
    return sorted((int(m.group(1)) for m in matches if m), reverse=True)


def remove_beyond(folder: Path, last_row: int) -> None:
    """Remove snapshots that the journal does not reach: once it grew past them they would pass for true.

    They are left where the journal was restored from a backup.
    """
    for row in rows_on_disk(folder):
        if row > last_row:
            (folder / f"snapshot-{row}.npz").unlink(missing_ok=True)


def load(path: Path, cell_m: float, config: FoldConfig, excluded: Collection[str] = ()) -> tuple[int, Grid] | None:
    """Return the row and the grid of a snapshot, or None if it is damaged or was made with other parameters."""
    try:
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
            header = json.loads(str(file["header"]))
            expected = _parameters(cell_m, config, excluded)
            if {key: header.get(key) for key in expected} != expected:
                return None
            state = GridState(_pages(file), *(header[name] for name in _TOTALS))
            if path.name != f"snapshot-{header['row']}.npz":
                raise ValueError(f"it is true for row {header['row']}")
            return header["row"], Grid.from_state(cell_m, config, state)
    except Exception as error:  # zipfile and numpy answer damage with a dozen kinds of error
        log.warning("snapshot passed over path=%s error=%r", path, str(error))
        return None


def load_newest(
    folder: Path, last_row: int, cell_m: float, config: FoldConfig, excluded: Collection[str] = ()
) -> tuple[int, Grid]:
    """Return the newest usable snapshot that the journal reaches, or row 0 and an empty grid."""
    for row in rows_on_disk(folder):
        if row <= last_row and (loaded := load(folder / f"snapshot-{row}.npz", cell_m, config, excluded)):
            return loaded
    return 0, Grid(cell_m, config)


def _parameters(cell_m: float, config: FoldConfig, excluded: Collection[str]) -> dict[str, object]:
    """What the evidence depends on."""
    fold = {**asdict(config), "std_floor_m": STD_FLOOR_M}
    bins = [ev.RESISTANCE_BINS, ev.GRADE_BINS, ev.SECTORS]
    return {"schema": ev.SCHEMA, "cell_m": cell_m, "bins": bins, "excluded": sorted(excluded), **fold}


def _arrays(pages: Sequence[PlacedPage]) -> dict[str, AnyArray]:
    """Pages as few long arrays: what each is and how long its parts are, and the parts end to end."""
    narrow = [at.page.votes for at in pages if at.page.votes.dtype == NARROW]
    wide = [at.page.votes for at in pages if at.page.votes.dtype == WIDE]
    rows = [
        (at.x, at.y, at.tier, at.index, at.page.votes.dtype == WIDE, len(at.page.votes), len(at.page.cells))
        for at in pages
    ]
    return {
        "pages": np.array(rows, np.int64).reshape(-1, 7),
        "narrow": np.concatenate([np.empty(0, NARROW), *narrow]),
        "wide": np.concatenate([np.empty(0, WIDE), *wide]),
        "cells": np.concatenate([np.empty(0, CELL), *(at.page.cells for at in pages)]),
    }


def _pages(file: Mapping[str, AnyArray]) -> tuple[PlacedPage, ...]:
    """Undo `_arrays`; pages are copies, so that those which are merged later give their memory back."""
    table, cells, parts = file["pages"], file["cells"], (file["narrow"], file["wide"])
    wide, votes, k = table[:, 4], table[:, 5], table[:, 6]
    if (table[:, 2:] < 0).any() or (wide > 1).any() or (k < 1).any():
        raise ValueError("a page of an impossible kind")
    for which, part in enumerate(parts):
        _check_order(part["place"], votes[wide == which], ev.COUNTS * ev.CELLS)
    _check_order(cells["cell"], k, ev.CELLS)
    pages, read = [], [0, 0, 0]
    for x, y, tier, index, which, n, m in table.tolist():
        page = Page(frozen(parts[which][read[which] :][:n]), frozen(cells[read[2] :][:m]))
        pages.append(PlacedPage(x, y, tier, index, page))
        read[which] += n
        read[2] += m
    return tuple(pages)


def _check_order(values: AnyArray, lengths: AnyArray, limit: int) -> None:
    """ValueError unless a part consists of pages, end to end: each in increasing order and below a limit."""
    if int(lengths.sum()) != len(values):
        raise ValueError("its parts have other lengths than its table of pages")
    rises = np.ones(len(values), np.bool_)
    rises[1:] = values[1:] > values[:-1]
    starts = np.cumsum(lengths)[:-1]
    rises[starts[starts < len(values)]] = True  # a new page begins
    if not rises.all() or (len(values) and int(values.max()) >= limit):
        raise ValueError("votes or cells that no page can have")
