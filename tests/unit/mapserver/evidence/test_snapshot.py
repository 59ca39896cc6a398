import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mapserver.evidence import cells as ev
from mapserver.evidence import snapshot
from mapserver.evidence.fold_config import FoldConfig
from mapserver.evidence.grid import Grid
from mapserver.evidence.pages import CompactPages
from tests.unit.mapserver.data import folded, random_samples, same, samples

FOLD = FoldConfig()
Change = Callable[[dict[str, Any]], object]


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def save(folder: Path, row: int, grid: Grid | None = None) -> Path:
    return snapshot.save(folder, row, (grid or folded(samples(3))).state(), 1.0, FOLD)


def test_a_snapshot_reads_back_to_the_bit(tmp_path):
    rows = random_samples(100, 6, half_m=2.0, std_m=4.0)
    rows["stamp_ns"] += np.arange(100) % 9 * 86_400 * 10**9
    wide = samples(30, distance_m=100.0)
    grid = folded(np.concatenate([rows, wide]))
    assert grid.skipped
    assert {at.tier for at in grid.state().pages} >= {0, 2}
    assert {len(pages.high) > 0 for _, _, pages in grid.state().blocks} == {False, True}
    row, again = snapshot.load(save(tmp_path, 17, grid), 1.0, FOLD) or (0, None)
    assert row == 17
    assert same(again, grid)


@pytest.mark.slow
def test_damage_anywhere_is_passed_over_or_harmless(tmp_path):
    grid = folded(samples(3))
    data = save(tmp_path, 1, grid).read_bytes()
    path, seed = tmp_path / "snapshot-2.npz", 7
    draw = np.random.default_rng(seed)
    ends = [*range(0, 300, 3), *range(len(data) - 500, len(data), 4), *draw.integers(0, len(data), 60)]
    passed_over = 0
    for place in ends:
        damaged = bytearray(data)
        damaged[place] ^= int(draw.choice([1, 8, 128, 255]))
        path.write_bytes(damaged)
        loaded = snapshot.load(path, 1.0, FOLD)
        passed_over += loaded is None
        assert loaded is None or (loaded[0] == 1 and same(loaded[1], grid)), f"byte {place}, seed {seed}"
    assert passed_over > 100


@pytest.mark.parametrize("share", [0.0, 0.001, 0.5, 0.999])
def test_a_truncated_snapshot_is_passed_over_for_the_one_before(tmp_path, share):
    save(tmp_path, 1)
    path = save(tmp_path, 2)
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    row, grid = snapshot.load_newest(tmp_path, 5, 1.0, FOLD)
    assert row == 1
    assert same(grid, folded(samples(3)))


OTHERS = {"bucket_s": 60.0, "std_cap_m": 2.0, "keep_buckets": 5, "keep_hours": 5, "keep_days": 5}


def test_a_snapshot_of_another_fold_schema_floor_or_cell_is_passed_over(tmp_path, monkeypatch):
    path = save(tmp_path, 1)
    assert snapshot.load(path, 1.0, FOLD)
    assert snapshot.load(path, 0.5, FOLD) is None
    for name, value in OTHERS.items():
        assert snapshot.load(path, 1.0, replace(FOLD, **{name: value})) is None, name
    for module, name, value in ((snapshot, "STD_FLOOR_M", 0.4), (ev, "SCHEMA", ev.SCHEMA + 1)):
        with monkeypatch.context() as patched:
            patched.setattr(module, name, value)
            assert snapshot.load(path, 1.0, FOLD) is None, name


def test_a_snapshot_of_other_facts_is_passed_over(tmp_path):
    state, facts = folded(samples(3)).state(), {"excluded": ["a", "b"], "corrections": "3c"}
    path = snapshot.save(tmp_path, 1, state, 1.0, FOLD, facts)
    assert snapshot.load(path, 1.0, FOLD, facts) is not None
    for other in ({"excluded": []}, {"excluded": ["a"]}, {"excluded": ["a", "b", "c"]}, {"corrections": ""}):
        assert snapshot.load(path, 1.0, FOLD, {**facts, **other}) is None
        assert snapshot.load_newest(tmp_path, 5, 1.0, FOLD, {**facts, **other})[0] == 0
    assert snapshot.load_newest(tmp_path, 5, 1.0, FOLD, facts)[0] == 1


# What is not caught makes a grid whose reads fail later, or a map with less in it; a checksum catches all that happens
# to a file by itself.
PARTS = CompactPages.__slots__


def changed(array: str, *place: int, value: int = 0, by: int = 0) -> Change:
    """Have another value at a place of an array, or one that is off by so much."""

    def change(arrays: dict[str, Any]) -> None:
        arrays[array][place] = arrays[array][place] + by if by else value

    return change


def made(array: str, remake: Callable[[Any], Any]) -> Change:
    return lambda arrays: arrays.__setitem__(array, remake(arrays[array]))


def without_total(name: str) -> Change:
    def without(header: Any) -> Any:
        return np.array(json.dumps({key: value for key, value in json.loads(str(header)).items() if key != name}))

    return made("header", without)


KINDS = (lambda part: part[:-1], lambda part: part[..., None], lambda part: part.astype("f4"))
CHANGES = {
    **{f"length {c} {n}": changed("blocks", 0, c, by=n) for c in range(2, 9) for n in (-1, 1, 10**6, -(10**6))},
    **{f"table {c} {v}": changed("table", 0, c, value=v) for c in (0, 2, 3, 4, 5) for v in (-1, 10**6)},
    **{f"table {c} 0": changed("table", 0, c) for c in (2, 3, 5)},
    "an index before the first": changed("table", 0, 1, value=-1),
    "a run of another plane": changed("runs", 0, 0, value=200),
    "a run that is too long": changed("runs", 0, 1, value=255),
    "runs out of order": changed("runs", 1, 0),
    "marks out of order": changed("marks", 1, 0),
    **{f"mark {c}": changed("marks", 0, c, value=255) for c in (1, 2, 3)},
    "a word that is too large": changed("words", 0, value=2**63),
    "a word of nothing": changed("words", 0),
    "cells out of order": made("cells", lambda cells: cells[::-1].copy()),
    **{  # no count is high: there is none to cut off
        f"{array} of kind {kind}": made(array, remake)
        for array in PARTS
        for kind, remake in enumerate(KINDS)
        if (array, kind) != ("high", 0)
    },
    **{f"no {array}": lambda arrays, array=array: arrays.pop(array) for array in ("header", "blocks", *PARTS)},
    **{f"no total {name}": without_total(name) for name in ("row", "folded", "skipped", "newest_ns")},
}


@pytest.fixture(scope="module")
def two_blocks(tmp_path_factory):
    with np.load(save(tmp_path_factory.mktemp("whole"), 1, folded(samples(2, x_m=[8.0, 24.0])))) as file:
        return dict(file)


@pytest.mark.parametrize("change", CHANGES)
def test_what_cannot_be_is_passed_over(tmp_path, two_blocks, change):
    arrays = {name: array.copy() for name, array in two_blocks.items()}
    np.savez(tmp_path / "snapshot-1.npz", **arrays)
    assert snapshot.load(tmp_path / "snapshot-1.npz", 1.0, FOLD)
    CHANGES[change](arrays)
    np.savez(tmp_path / "snapshot-1.npz", **arrays)
    assert snapshot.load(tmp_path / "snapshot-1.npz", 1.0, FOLD) is None


def test_a_snapshot_beyond_the_journal_is_passed_over(tmp_path):
    save(tmp_path, 3), save(tmp_path, 8)
    assert [snapshot.load_newest(tmp_path, row, 1.0, FOLD)[0] for row in (8, 7, 3)] == [8, 3, 3]
    assert snapshot.load_newest(tmp_path, 2, 1.0, FOLD)[0] == 0


def test_only_the_newest_two_are_kept_and_nothing_else_is_left(tmp_path):
    for row in (1, 5, 9, 10, 100):
        save(tmp_path, row)
    assert snapshot.rows_on_disk(tmp_path) == [100, 10]
    assert names(tmp_path) == ["snapshot-10.npz", "snapshot-100.npz"]
