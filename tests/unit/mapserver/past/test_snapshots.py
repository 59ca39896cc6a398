"""Snapshots: checkpoints closed now, so a restart folds only later rows."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mapserver.evidence import cells as ev
from mapserver.evidence.fold_config import FoldConfig
from mapserver.evidence.grid import Grid
from mapserver.evidence.pages import as_numbers
from mapserver.evidence.record_kernels import parts
from mapserver.journal.facts import NO_FACTS, Facts
from mapserver.past import past
from mapserver.past.checkpoint_file import OPEN_END_NS, Checkpoint, CheckpointWriter, DamagedError, Header
from mapserver.past.checkpoints import remove_beyond, save_snapshot, snapshot_path, snapshot_rows
from mapserver.past.past import StorePast
from tests.unit.mapserver.data import folded, random_samples, same, samples
from tests.unit.mapserver.past.past_store import HOUR_NS, NOW_NS, PastStore

ROWS = 9


@pytest.fixture
def store(tmp_path):
    with closing(PastStore(tmp_path)) as opened:
        for _ in range(ROWS):
            opened.add(samples(3))
        yield opened


def save(store: PastStore, row: int, grid: Grid | None = None, facts: Facts = NO_FACTS) -> Path:
    depends_on = store.past.depends_on(store.reader, facts)(OPEN_END_NS)
    return save_snapshot(store.folder, row, depends_on, (grid or folded(samples(3))).state())


def newest(store: PastStore, facts: Facts = NO_FACTS, **other: object) -> tuple[int, Grid]:
    return replace(StorePast.of_store(store.folder, 1.0, FoldConfig()), **other).newest(store.reader, facts)


def test_a_snapshot_reads_back_to_the_bit(store):
    rows = random_samples(100, 6, half_m=2.0, std_m=4.0)
    rows["stamp_ns"] += np.arange(100) % 9 * 86_400 * 10**9
    grid = folded(np.concatenate([rows, samples(30, distance_m=100.0)]))
    assert grid.skipped
    assert {at.tier for at in grid.state().pages} >= {0, 2}
    assert {len(parts(as_numbers(record), 0)[4]) > 0 for *_, record in grid.state().blocks} == {False, True}
    save(store, 8, grid)
    row, again = newest(store)
    assert row == 8
    assert same(again, grid)


def test_a_map_of_now_begins_with_a_snapshot_and_one_of_the_past_does_not(store, monkeypatch):
    store.make(NOW_NS + HOUR_NS)
    save(store, 5, folded(samples(3 * 5)))
    begun = []
    monkeypatch.setattr(StorePast, "lacking", lambda _self, _reader, base, *_: begun.append(base) or iter(()))
    store.as_of(OPEN_END_NS - 1)
    store.as_of(NOW_NS + 2 * HOUR_NS)
    assert [header.closed_ns for header in begun] == [OPEN_END_NS, NOW_NS + HOUR_NS]
    assert [entry.closed_ns for entry in store.past.checkpoints.entries(lambda _: {}, ROWS)] == [NOW_NS + HOUR_NS]


def test_with_any_snapshot_the_map_of_now_is_a_fold_from_the_start(tmp_path):
    with closing(PastStore(tmp_path)) as store:
        for seed in range(3):
            store.add(random_samples(20, seed), "ab"[seed % 2])
        save(store, store.reader.last_row, store.folded(OPEN_END_NS))
        store.add(random_samples(20, 7))  # stamped before and after the snapshot's
        store.archive(2)
        assert same(store.as_of(OPEN_END_NS - 1), store.folded(OPEN_END_NS))


def test_a_snapshot_whose_block_is_damaged_is_passed_over_for_the_one_before(store):
    save(store, 1)
    path = save(store, 2)
    data = bytearray(path.read_bytes())
    data[100] ^= 1
    path.write_bytes(data)
    assert newest(store)[0] == 1


OTHERS = {"bucket_s": 60.0, "std_cap_m": 2.0, "keep_buckets": 5, "keep_hours": 5, "keep_days": 5}


def test_a_snapshot_of_another_fold_schema_floor_cell_or_facts_is_passed_over(store, monkeypatch):
    some = Facts(frozenset("ab"))
    save(store, 1, facts=some)
    assert newest(store, some)[0] == 1
    assert newest(store, some, cell_m=0.5)[0] == 0
    for name, value in OTHERS.items():
        assert newest(store, some, config=replace(FoldConfig(), **{name: value}))[0] == 0, name
    for facts in (NO_FACTS, Facts(frozenset("a")), Facts(frozenset("abc"))):
        assert newest(store, facts)[0] == 0
    for module, name, value in ((past, "STD_FLOOR_M", 0.4), (ev, "SCHEMA", ev.SCHEMA + 1)):
        with monkeypatch.context() as patched:
            patched.setattr(module, name, value)
            assert newest(store, some)[0] == 0, name


def test_a_snapshot_beyond_the_journal_is_passed_over_and_removed(store):
    save(store, 3), save(store, 8)
    for last_row, row in ((8, 8), (7, 3), (3, 3), (2, 0)):
        assert newest(store, trusted_row=lambda _, last_row=last_row: last_row)[0] == row
    snapshot_path(store.folder, 8).write_bytes(b"damaged")
    remove_beyond(store.folder, 7)
    assert snapshot_rows(store.folder) == [3]


def test_only_the_newest_two_are_kept_and_nothing_else_is_left(store):
    for row in (1, 5, 9, 10, 100):
        save(store, row)
    assert snapshot_rows(store.folder) == [100, 10]
    assert sorted(path.name for path in store.folder.glob("*snap*")) == [
        "snapshot-10.checkpoint",
        "snapshot-100.checkpoint",
    ]


def test_a_snapshot_under_another_name_is_not_what_its_name_says(store):
    save(store, 3).rename(snapshot_path(store.folder, 4))
    assert newest(store)[0] == 0


# Impossible pages under a right checksum: later reads would fail, or the map lack data.
PARTS = ("header", "known", "table", "marks", "words", "counts", "high", "places", "runs")
CHANGES = {
    **{f"header {c} {v}": ("header", (c,), v) for c in range(6) for v in (-1, 2**31 - 1)},
    "counts of two kinds": ("header", (4,), 2),
    "another known cell": ("known", (0,), 1),
    **{f"table {c} {v}": ("table", (0, c), v) for c in (0, 2, 3, 4, 5) for v in (-1, 10**6)},
    **{f"table {c} 0": ("table", (0, c), 0) for c in (2, 3, 5)},
    "an index before the first": ("table", (0, 1), -1),
    "a run of another plane": ("runs", (0, 0), 200),
    "a run that is too long": ("runs", (0, 1), 255),
    "runs out of order": ("runs", (1, 0), 0),
    "marks out of order": ("marks", (1, 0), 0),
    **{f"mark {c}": ("marks", (0, c), 255) for c in (1, 2, 3)},
    "a word that is too large": ("words", (0,), 2**63),
    "a word of nothing": ("words", (0,), 0),
    "a word of more than three lists": ("words", (0,), 2**27),
    "cells out of order": ("places", (0,), 255),
}


@pytest.mark.parametrize("change", CHANGES)
def test_pages_that_cannot_be_are_damage(tmp_path, change):
    part, place, value = CHANGES[change]
    x, y, record = folded(samples(2, x_m=[8.0, 24.0])).state().blocks[0]
    changed = np.frombuffer(record, np.uint8).copy()
    views = changed[:24].view(np.int32), changed[24:56].view(np.uint64), *parts(as_numbers(changed), 0)
    views[PARTS.index(part)][place] = value
    with (tmp_path / "one").open("wb") as file:
        writer = CheckpointWriter(file)
        writer.add(x, y, changed.tobytes())
        writer.finish(Header(0, 0, {}))
    with Checkpoint(tmp_path / "one") as checkpoint, pytest.raises(DamagedError):
        list(checkpoint.blocks(checkpoint.numbers_in(None)))
