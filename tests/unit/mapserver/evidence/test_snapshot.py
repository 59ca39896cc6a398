import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mapserver.evidence import cells as ev
from mapserver.evidence import snapshot
from mapserver.evidence.fold_config import FoldConfig
from mapserver.evidence.grid import Grid
from mapserver.evidence.pages import CompactPages
from protocol.wire.messages import Ack
from tests.unit.mapserver.data import CONFIG, folded, incoming, merged, open_store, random_samples, same, samples

FOLD = FoldConfig()


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def save(folder: Path, row: int, grid: Grid | None = None) -> Path:
    return snapshot.save(folder, row, (grid or folded(samples(3))).state(), 1.0, FOLD)


@pytest.mark.parametrize("after", [0, 3, 10])
def test_snapshot_and_tail_are_the_fold_of_everything(tmp_path, after):
    running, copy = open_store(tmp_path / "store"), tmp_path / "copy"
    parts = np.split(random_samples(200, 5), 10)
    for i, part in enumerate(parts):
        if i == after:
            running.save_snapshot()
        assert isinstance(running.commit([incoming(part, 1 + 20 * i)])[0], Ack)
    if after == 10:
        running.save_snapshot()
    shutil.copytree(tmp_path / "store", copy)  # as after a power cut: the log is not folded into the journal
    restarted = open_store(copy)
    assert restarted.snapshot_row == after
    assert same(restarted.grid, running.grid)
    assert same(restarted.grid, folded(np.concatenate(parts)))
    assert (restarted.merged, restarted.journalled, restarted.newest_ns) == (10, 10, running.newest_ns)
    restarted.close(), running.close()


def test_an_empty_folder_gives_an_empty_grid(tmp_path):
    row, grid = snapshot.load_newest(tmp_path, 100, 1.0, FOLD)
    assert (row, grid.known_cells()) == (0, 0)


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


def test_a_snapshot_of_another_schema_is_passed_over(tmp_path, monkeypatch):
    path = save(tmp_path, 1)
    monkeypatch.setattr(ev, "SCHEMA", ev.SCHEMA + 1)
    assert snapshot.load(path, 1.0, FOLD) is None


@pytest.mark.parametrize(
    "change", [{"bucket_s": 60.0}, {"std_cap_m": 2.0}, {"keep_buckets": 5}, {"keep_hours": 5}, {"keep_days": 5}]
)
def test_a_snapshot_of_other_parameters_is_passed_over(tmp_path, change):
    assert snapshot.load(save(tmp_path, 1), 1.0, replace(FOLD, **change)) is None


def test_a_snapshot_of_other_cells_or_another_floor_is_passed_over(tmp_path, monkeypatch):
    path = save(tmp_path, 1)
    assert snapshot.load(path, 0.5, FOLD) is None
    monkeypatch.setattr(snapshot, "STD_FLOOR_M", 0.4)
    assert snapshot.load(path, 1.0, FOLD) is None


def test_a_snapshot_of_other_facts_is_passed_over(tmp_path):
    state, facts = folded(samples(3)).state(), {"excluded": ["a", "b"], "corrections": "3c"}
    path = snapshot.save(tmp_path, 1, state, 1.0, FOLD, facts)
    assert snapshot.load(path, 1.0, FOLD, facts) is not None
    for other in ({"excluded": []}, {"excluded": ["a"]}, {"excluded": ["a", "b", "c"]}, {"corrections": ""}):
        assert snapshot.load(path, 1.0, FOLD, {**facts, **other}) is None
        assert snapshot.load_newest(tmp_path, 5, 1.0, FOLD, {**facts, **other})[0] == 0
    assert snapshot.load_newest(tmp_path, 5, 1.0, FOLD, facts)[0] == 1


def test_an_empty_grid_is_kept_too(tmp_path):
    row, grid = snapshot.load(save(tmp_path, 3, Grid(1.0, FOLD)), 1.0, FOLD) or (0, None)
    assert row == 3
    assert same(grid, Grid(1.0, FOLD))


# What is not caught makes a grid whose reads fail later, or a map with less in it; a checksum catches all that happens
# to a file by itself.
PARTS = CompactPages.__slots__


@pytest.mark.parametrize("column", range(2, 9))
@pytest.mark.parametrize("change", [-1, 1, 10**6, -(10**6)])
def test_blocks_of_other_lengths_are_passed_over(tmp_path, column, change):
    def changed(arrays):
        arrays["blocks"][0, column] += change

    assert load_changed(tmp_path, changed) is None


@pytest.mark.parametrize(
    ("array", "value"),
    [
        *(("table", (0, column, value)) for column in (0, 2, 3, 4, 5) for value in (-1, 10**6)),
        *(("table", (0, column, 0)) for column in (2, 3, 5)),
        ("table", (0, 1, -1)),
        ("runs", (0, 0, 200)),
        ("runs", (0, 1, 255)),
        ("runs", (1, 0, 0)),
        ("marks", (1, 0, 0)),
        *(("marks", (0, column, 255)) for column in (1, 2, 3)),
        ("words", (0, 2**63)),
        ("words", (0, 0)),
    ],
)
def test_pages_that_cannot_be_are_passed_over(tmp_path, array, value):
    def changed(arrays):
        *place, number = value
        arrays[array][tuple(place)] = number

    assert load_changed(tmp_path, changed) is None


def test_votes_out_of_order_are_passed_over(tmp_path):
    def changed(arrays):
        arrays["cells"] = arrays["cells"][::-1].copy()

    assert load_changed(tmp_path, changed) is None


@pytest.mark.parametrize("array", PARTS)
@pytest.mark.parametrize(
    "change", [lambda part: part[:-1], lambda part: part[..., None], lambda part: part.astype("f4")]
)
def test_arrays_of_another_kind_are_passed_over(tmp_path, array, change):
    def changed(arrays):
        arrays[array] = change(arrays[array])

    if array != "high" or len(change(np.zeros(4, np.uint16))) == 4:  # no count is high: there is none to cut off
        assert load_changed(tmp_path, changed) is None


@pytest.mark.parametrize("array", ["header", "blocks", *PARTS])
def test_a_missing_array_is_passed_over(tmp_path, array):
    assert load_changed(tmp_path, lambda arrays: arrays.pop(array)) is None


@pytest.mark.parametrize("name", ["row", "folded", "skipped", "newest_ns"])
def test_a_header_without_a_total_is_passed_over(tmp_path, name):
    def change(arrays):
        header = json.loads(str(arrays["header"]))
        del header[name]
        arrays["header"] = np.array(json.dumps(header))

    assert load_changed(tmp_path, change) is None


def load_changed(folder: Path, change):
    """Load a snapshot of two blocks, of which something was changed in a way that no checksum sees."""
    path = save(folder, 1, folded(samples(2, x_m=[8.0, 24.0])))
    with np.load(path) as file:
        arrays = dict(file)
    change(arrays)
    np.savez(path, **arrays)
    return snapshot.load(path, 1.0, FOLD)


def test_a_snapshot_under_the_name_of_an_earlier_row_is_passed_over(tmp_path):
    save(tmp_path, 8).rename(tmp_path / "snapshot-2.npz")
    assert snapshot.load_newest(tmp_path, 5, 1.0, FOLD)[0] <= 5


FOLD_A_PART = """
import sys
from pathlib import Path
import numpy as np
from mapserver.evidence import snapshot
from mapserver.evidence.grid import Grid
from mapserver.evidence.fold_config import FoldConfig

folder, part, waiting_rows = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
config = FoldConfig()
grid = Grid(1.0, config, waiting_rows)
for machine in ("a", "b"):
    grid.fold(np.load(folder.parent / f"{machine}.npy")[part::3], machine)
snapshot.save(folder, 1, grid.state(), 1.0, config)
"""


@pytest.mark.slow
def test_parts_folded_in_processes_of_their_own_are_the_fold_of_everything(tmp_path):
    """Three processes, which hash strings in three ways, with different space."""
    rows = {machine: random_samples(90, seed, half_m=3.0) for seed, machine in enumerate("ab")}
    for machine, one in rows.items():
        one["stamp_ns"] += np.arange(90) % 30 * 9 * 3600 * 10**9
        np.save(tmp_path / f"{machine}.npy", one)
    children = []
    for part, waiting_rows in enumerate((1, 64, 512)):
        (folder := tmp_path / str(part)).mkdir()
        words = [sys.executable, "-c", FOLD_A_PART, folder, str(part), str(waiting_rows)]
        children.append(subprocess.Popen(words, env={**os.environ, "PYTHONHASHSEED": str(part + 1)}))
    assert [child.wait(60) for child in children] == [0, 0, 0]

    def parts() -> list[Grid]:
        return [snapshot.load_newest(tmp_path / str(part), 1, 1.0, FOLD)[1] for part in range(3)]

    whole = folded(rows["a"])
    whole.fold(rows["b"], "b")
    assert {at.tier for at in whole.state().pages} == {0, 1, 2, 3}
    assert same(merged(parts()), whole)
    assert same(merged(parts()[::-1]), whole)


def test_a_snapshot_beyond_the_journal_is_passed_over(tmp_path):
    save(tmp_path, 3), save(tmp_path, 8)
    assert snapshot.load_newest(tmp_path, 7, 1.0, FOLD)[0] == 3
    assert snapshot.load_newest(tmp_path, 2, 1.0, FOLD)[0] == 0


def test_only_the_newest_two_are_kept_and_nothing_else_is_left(tmp_path):
    for row in (1, 5, 9, 10, 100):
        save(tmp_path, row)
    assert snapshot.rows_on_disk(tmp_path) == [100, 10]
    assert names(tmp_path) == ["snapshot-10.npz", "snapshot-100.npz"]


def test_a_full_disk_leaves_the_old_snapshot_and_nothing_beside_it(tmp_path, monkeypatch):
    save(tmp_path, 1)

    def full(file, **arrays):
        file.write(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", full)
    with pytest.raises(OSError, match="space"):
        save(tmp_path, 2)
    assert names(tmp_path) == ["snapshot-1.npz"]


def test_what_a_kill_left_half_written_is_replaced(tmp_path):
    (tmp_path / ".snapshot-1.npz.1.0.part").write_bytes(b"half")
    save(tmp_path, 2)
    assert names(tmp_path) == ["snapshot-2.npz"]


def test_other_files_are_no_snapshots(tmp_path):
    for name in ("snapshot-x.npz", "snapshot-1.npz.old", "my-snapshot-3.npz"):
        (tmp_path / name).touch()
    assert snapshot.rows_on_disk(tmp_path) == []


def test_snapshots_that_a_restored_journal_does_not_reach_never_come_back(tmp_path):
    """A backup of the journal is put back; later it grows past the snapshots of the history that is gone."""
    store, backup = open_store(tmp_path / "store"), tmp_path / "backup.db"
    parts = np.split(random_samples(120, 8), 6)
    store.commit([incoming(parts[0], 1)])
    store.close()
    shutil.copy(tmp_path / "store" / "journal.db", backup)
    store = open_store(tmp_path / "store")
    for i in (1, 2):
        store.commit([incoming(parts[i], 1 + 20 * i)])
    store.save_snapshot()  # of row 3
    store.close()
    shutil.copy(backup, tmp_path / "store" / "journal.db")
    store = open_store(tmp_path / "store")
    for i in (3, 4, 5):
        store.commit([incoming(parts[i], 21 + 20 * (i - 3))])
    assert store.journalled == 4
    store.close()  # without a snapshot, as a kill would
    store = open_store(tmp_path / "store")
    assert same(store.grid, folded(np.concatenate([parts[i] for i in (0, 3, 4, 5)])))
    store.close()


def test_parameters_of_a_store_reach_its_snapshot(tmp_path):
    store = open_store(tmp_path)
    store.commit([incoming(samples(5))])
    store.save_snapshot()
    store.close()
    changed = replace(CONFIG, fold=replace(CONFIG.fold, std_cap_m=0.35))
    store = open_store(tmp_path, changed)
    assert store.snapshot_row == 0  # folded again
    assert store.grid.config.std_cap_m == 0.35
    assert store.merged == 1
    store.close()
