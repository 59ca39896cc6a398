"""Snapshots: the grid as of one journal row, so that a restart folds only the tail.

A snapshot is a cache, never the truth: one that is damaged, of another schema or of other parameters is passed over,
and the journal is folded again.
"""

from __future__ import annotations

import json
import logging
import os
import re
from dataclasses import asdict
from pathlib import Path

import numpy as np

from mapserver import evidence as ev
from mapserver.grid import Grid, GridState
from mapserver.votes import FoldConfig

_NAME = re.compile(r"snapshot-(\d+)\.npz")
KEEP = 2
log = logging.getLogger("mapserver.snapshot")


def save(folder: Path, row: int, state: GridState, cell_m: float, config: FoldConfig) -> Path:
    """Write a snapshot that is true for journal row `row`, and remove all but the newest two."""
    path = folder / f"snapshot-{row}.npz"
    temporary = folder / "snapshot.tmp"
    header = {**_parameters(cell_m, config), "row": row, "folded": state.folded, "skipped": state.skipped}
    arrays = {"codes": state.codes, "counts": state.counts, "bitmaps": state.bitmaps, "newest": state.newest}
    try:
        with temporary.open("wb") as file:
            np.savez(file, header=np.array(json.dumps(header)), **arrays)  # type: ignore[arg-type]
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)  # after a full disk
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


def load(path: Path, cell_m: float, config: FoldConfig) -> tuple[int, Grid] | None:
    """Return the row and the grid of a snapshot, or None if it is damaged or was made with other parameters."""
    try:
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
            header = json.loads(str(file["header"]))
            expected = _parameters(cell_m, config)
            if {key: header.get(key) for key in expected} != expected:
                return None
            arrays = (file["codes"], file["counts"], file["bitmaps"], file["newest"])
            state = GridState(*arrays, header["folded"], header["skipped"])
            return header["row"], Grid.from_state(cell_m, config, state)
    except Exception as error:  # zipfile and numpy answer damage with a dozen kinds of error
        log.warning("snapshot passed over path=%s error=%r", path, str(error))
        return None


def load_newest(folder: Path, last_row: int, cell_m: float, config: FoldConfig) -> tuple[int, Grid]:
    """Return the newest usable snapshot that the journal reaches, or row 0 and an empty grid."""
    for row in rows_on_disk(folder):
        if row <= last_row and (found := load(folder / f"snapshot-{row}.npz", cell_m, config)):
            return found
    return 0, Grid(cell_m, config)


def _parameters(cell_m: float, config: FoldConfig) -> dict[str, object]:
    """What the evidence depends on; the kernel is not part of it, all kernels agree."""
    fold = {key: value for key, value in asdict(config).items() if key != "kernel"}
    return {"schema": ev.SCHEMA, "cell_m": cell_m, "bins": [ev.RESISTANCE_BINS, ev.GRADE_BINS, ev.SECTORS], **fold}
