"""A checkpoint changes no map of the past: with it or without it, these are folds of the same samples."""

import tempfile
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapserver.journal.facts import NO_FACTS
from mapserver.past import making
from mapserver.past.checkpoint_file import Checkpoint, DamagedError
from mapserver.past.making import make
from mapserver.past.plan import HOUR_NS
from tests.unit.mapserver.data import NOW_NS, random_samples, same
from tests.unit.mapserver.past.past_store import PastStore, S

pytest.importorskip("pyarrow.parquet")
HOURS = 4


@pytest.fixture
def store(tmp_path):
    with closing(PastStore(tmp_path)) as opened:
        yield opened


def some_samples(seed: int, n: int = 40, first_h: float = 0.0, hours: float = HOURS):
    """Samples of some hours, in any order; a few at full hours to the nanosecond."""
    rows = random_samples(n, seed, half_m=25.0)
    draw = np.random.default_rng(seed)
    stamps = NOW_NS + round(first_h * HOUR_NS) + draw.integers(0, max(1, round(hours * HOUR_NS)), n)
    stamps[::9] = stamps[::9] // HOUR_NS * HOUR_NS
    stamps[4::9] = stamps[4::9] // HOUR_NS * HOUR_NS - 1
    rows["stamp_ns"] = np.maximum(stamps, NOW_NS)
    return rows


ACTIONS = st.one_of(
    st.tuples(st.just("add"), st.integers(0, 10**6), st.sampled_from("abc")),
    st.tuples(st.just("make"), st.integers(0, HOURS), st.sets(st.sampled_from("ab"), max_size=1)),
    st.tuples(st.just("archive"), st.integers(0, 8), st.none()),
)


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(actions=st.lists(ACTIONS, min_size=3, max_size=14), ask=st.integers(-1, HOURS * 3600), fine=st.booleans())
def test_whatever_came_late_was_excluded_or_archived_the_past_is_a_fold_from_the_start(actions, ask, fine):
    to_ns = NOW_NS + ask * S - fine
    with tempfile.TemporaryDirectory() as folder, closing(PastStore(Path(folder))) as store:
        for what, number, more in actions:
            if what == "add":
                store.add(some_samples(number, 20), more)
            elif what == "make":
                store.make(NOW_NS + number * HOUR_NS, more)
            else:
                store.archive(number)
        for without in ((), ("a",), ("b",)):
            assert same(store.as_of(to_ns, without), store.folded(to_ns, without))


def test_late_samples_are_folded_in_when_they_are_read_and_when_it_is_made_again(store):
    closed_ns = NOW_NS + 2 * HOUR_NS
    store.add(some_samples(1))
    store.make(closed_ns)
    store.add(some_samples(2), "b")  # late
    with Checkpoint(store.past.checkpoints.path(closed_ns)) as before:
        assert before.header.row == 1
        assert store.past.late_rows(store.reader, before.header) == 1
    assert same(store.as_of(closed_ns), store.folded(closed_ns))
    store.make(closed_ns)
    with Checkpoint(store.past.checkpoints.path(closed_ns)) as after:
        assert store.past.late_rows(store.reader, after.header) == 0
        assert same(store.past.grid(after), store.folded(closed_ns - 1))
    assert same(store.as_of(closed_ns), store.folded(closed_ns))


@pytest.mark.parametrize("spill", [50, 10**6])
def test_memory_is_bounded_by_parts_that_go_to_disk(store, monkeypatch, spill):
    monkeypatch.setattr(making, "SPILL_SAMPLES", spill)
    for seed in range(6):
        store.add(some_samples(seed), "ab"[seed % 2])
    store.archive(3)
    store.make(NOW_NS + 3 * HOUR_NS)
    with Checkpoint(store.past.checkpoints.path(NOW_NS + 3 * HOUR_NS)) as checkpoint:
        assert same(store.past.grid(checkpoint), store.folded(NOW_NS + 3 * HOUR_NS - 1))
    assert [path.name for path in store.past.checkpoints.folder.iterdir()] == ["2026-01-01T03.checkpoint"]


@pytest.mark.parametrize("steps", [1, 2, 3])
def test_one_that_is_given_up_leaves_what_was_there(store, steps, monkeypatch):
    monkeypatch.setattr(making, "SPILL_SAMPLES", 30)
    store.add(some_samples(1))
    store.make(NOW_NS + HOUR_NS)
    before = {path.name: path.read_bytes() for path in store.past.checkpoints.folder.iterdir()}
    store.add(some_samples(2), "b")
    running = make(store.past, store.reader, NOW_NS + HOUR_NS, NO_FACTS)
    for _ in range(steps):
        next(running)
    running.close()
    assert {path.name: path.read_bytes() for path in store.past.checkpoints.folder.iterdir()} == before


def test_damage_in_what_it_begins_with_is_found_and_the_next_attempt_does_without(store):
    store.add(some_samples(1))
    store.make(NOW_NS + HOUR_NS)
    path = store.past.checkpoints.path(NOW_NS + HOUR_NS)
    data = bytearray(path.read_bytes())
    data[100] ^= 1
    path.write_bytes(data)
    with pytest.raises(DamagedError, match="a block is damaged; it is made again"):
        store.make(NOW_NS + 2 * HOUR_NS)
    assert store.past.checkpoints.passed_over == 1
    store.make(NOW_NS + 2 * HOUR_NS)
    assert same(store.as_of(NOW_NS + 2 * HOUR_NS), store.folded(NOW_NS + 2 * HOUR_NS))
