"""Tasks by file and tile give the fold of all samples, bit for bit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mapserver.evidence.fold_config import FoldConfig
from mapserver.evidence.grid import Grid
from mapserver.evidence.grid_state import GridState
from mapserver.journal.rows import ALL, JournalRow, Selection
from protocol.errors import SitegridError, StoreError
from sitegrid.refold import work
from sitegrid.refold.parts import LookTask, look
from sitegrid.refold.work import Fold, FoldTask, PartWork, fold_parts, merge_tile, merged_state, tiles
from tests.unit.mapserver.data import same_state
from tests.unit.sitegrid.refold.archives import SITE, fold_in, samples, write

pytest.importorskip("pyarrow.parquet")
CONFIGS = (FoldConfig(), FoldConfig(keep_buckets=1, keep_hours=1, keep_days=1), FoldConfig(bucket_s=60, keep_days=2))


def split(rng: np.random.Generator, folder: Path, *, heavy: bool) -> tuple[list[JournalRow], list[list[JournalRow]]]:
    """Rows of three machines, and the same in random files."""
    rows = [
        JournalRow(
            number, f"m{rng.integers(3)}", number, 1, samples(rng, int(rng.integers(1, 40)), heavy=heavy), number
        )
        for number in range(1, int(rng.integers(4, 12)))
    ]
    owner = rng.integers(0, int(rng.integers(1, 6)), len(rows))
    files = [[row for row, at in zip(rows, owner, strict=True) if at == n] for n in range(6)]
    return rows, [file for file in files if file]


def task_of(fold: Fold, parts: list[PartWork]) -> FoldTask:
    return FoldTask(fold, tuple(parts), 1)


def works(folder: Path, files: list[list[JournalRow]], selection: Selection = ALL) -> list[PartWork]:
    """Consecutively numbered parts."""
    parts, row = [], 1
    for number, rows in enumerate(files):
        held = look(LookTask(write(folder / str(number), rows), selection))
        parts.append(PartWork(held.part, held.origin.identity, held.first_ns, row, held.rows, held.samples, ()))
        row += held.rows
    return parts


def state_of(fold: Fold, tasks: list[FoldTask]) -> GridState:
    """Result of tasks by tile."""
    for task in tasks:
        fold_parts(task)
    evidence = [task.evidence for task in tasks]
    cut = list(tiles(fold, evidence))
    for tile in cut:
        merge_tile(tile)
    return merged_state(evidence, [tile.path for tile in cut])


def folded(rows: list[JournalRow], cell_m: float, config: FoldConfig) -> GridState:
    grid = Grid(cell_m, config)
    for row in rows:
        grid.fold(row.rows, row.machine)
    return grid.state()


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))  # all kinds of cell and config, heavy samples
def test_any_split_and_any_tiles_come_to_the_fold_of_all(seed: int, tmp_path: Path, monkeypatch) -> None:
    """With stencils larger than a tile (16 cells, or 0.8 m), and counts beyond 16 and 32 bits."""
    rng = np.random.default_rng(seed)
    monkeypatch.setattr(work, "LEAST_TILE", 1)
    monkeypatch.setattr(work, "MERGED_AT_ONCE", int(rng.integers(1, 4)))
    cell_m, config = (1.0, 1.0, 0.05)[seed % 3], CONFIGS[seed % len(CONFIGS)]
    rows, files = split(rng, tmp_path, heavy=seed % 5 == 4)
    fold = fold_in(tmp_path / "work", config, site=replace(SITE, cell_m=cell_m))
    tasks = [task_of(fold, [part]) for part in works(tmp_path, files)]
    assert same_state(state_of(fold, tasks), folded(rows, cell_m, config))


def test_counts_saturate_across_tasks(tmp_path: Path) -> None:
    heavy = [
        JournalRow(n, "m", n, 1, samples(np.random.default_rng(n), 24_000, days=0.003, heavy=True), n) for n in (1, 2)
    ]
    fold = fold_in(tmp_path / "work")
    apart = state_of(fold, [task_of(fold, [part]) for part in works(tmp_path, [[row] for row in heavy])])
    assert same_state(apart, folded(heavy, 1.0, fold.config))
    assert max(int(at.page.votes["count"].max()) for at in apart.pages) == 2**32 - 1


def test_a_task_that_is_done_is_not_done_again_and_one_that_is_half_done_is(tmp_path: Path) -> None:
    _, files = split(np.random.default_rng(3), tmp_path, heavy=False)
    fold = fold_in(tmp_path / "work")
    task = task_of(fold, works(tmp_path, files))
    fold_parts(task)
    before = {path: path.stat().st_ino for path in fold.folder.iterdir()}
    fold_parts(task)
    assert before == {path: path.stat().st_ino for path in fold.folder.iterdir()}
    task.samples(task.parts[0]).unlink()
    fold_parts(task)
    assert set(before) == set(fold.folder.iterdir())
    other = task_of(replace(fold, selection=replace(ALL, from_ns=5)), list(task.parts))
    assert other.evidence != task.evidence


def test_damaged_evidence_is_named_and_removed(tmp_path: Path) -> None:
    _, files = split(np.random.default_rng(4), tmp_path, heavy=False)
    fold = fold_in(tmp_path / "work")
    task = task_of(fold, works(tmp_path, files))
    fold_parts(task)
    task.evidence.write_bytes(task.evidence.read_bytes()[:-9])
    with pytest.raises(StoreError, match="was damaged, and is removed; run the same command again"):
        list(tiles(fold, [task.evidence]))
    assert not task.evidence.exists()


def test_a_part_that_changes_meanwhile_is_no_part(tmp_path: Path) -> None:
    _, files = split(np.random.default_rng(5), tmp_path, heavy=False)
    fold = fold_in(tmp_path / "work")
    (part, *_) = works(tmp_path, files)
    with pytest.raises(StoreError, match="has changed while it was folded"):
        fold_parts(task_of(fold, [replace(part, rows=part.rows + 1)]))
    assert [path.name for path in fold.folder.iterdir()] == [work.STORE_FILE]


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"code": "0" * 12}, "has another version of sitegrid"),
        ({"store": "f" * 16}, "does not see this folder; all workers have to share the one where --out is"),
        ({"folder": Path("/nowhere")}, "/nowhere: a worker on .* does not see this folder"),
    ],
)
def test_a_worker_that_is_of_no_use_says_so(tmp_path: Path, change: dict[str, object], problem: str) -> None:
    fold = replace(fold_in(tmp_path / "work"), **change)
    with pytest.raises(SitegridError, match=problem):
        fold_parts(FoldTask(fold, (), 1))
