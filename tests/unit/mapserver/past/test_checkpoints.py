"""Checkpoints: schedule, making, files, validity."""

import shutil
import tempfile
from contextlib import closing
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapserver.evidence.fold_config import FoldConfig
from mapserver.evidence.grid import Grid
from mapserver.evidence.grid_state import GridState
from mapserver.journal.facts import NO_FACTS, Facts
from mapserver.past import making
from mapserver.past.checkpoint_file import MAGIC, Checkpoint, CheckpointWriter, DamagedError, Header
from mapserver.past.checkpoints import remove_beyond
from mapserver.past.making import make
from mapserver.past.plan import GRACE_NS, due, surplus, thinned
from protocol.site.geometry import CellWindow
from protocol.units import DAY_NS, HOUR_NS
from tests.unit.mapserver.data import NOW_NS, filled_to, folded, random_samples, same
from tests.unit.mapserver.past.past_store import PastStore, S


@pytest.fixture
def store(tmp_path):
    with closing(PastStore(tmp_path)) as opened:
        for hour in (1, 2, 3):
            opened.add(random_samples(20, hour))
            opened.make(NOW_NS + hour * HOUR_NS)
        yield opened


def nearest(store: PastStore, hour: float, without=(), last_row: int = 3) -> int | None:
    facts = store.past.depends_on(store.reader, Facts(frozenset(without)))
    checkpoint = store.past.checkpoints.nearest(NOW_NS + round(hour * HOUR_NS), facts, last_row)
    if checkpoint is None:
        return None
    checkpoint.close()
    return (checkpoint.header.closed_ns - NOW_NS) // HOUR_NS


def test_one_of_another_fold_or_store_is_not_used(store, tmp_path):
    facts = store.past.depends_on(store.reader, NO_FACTS)
    for name, other in (("keep_hours", 5), ("cell_m", 2.0), ("schema", 0), ("store", "another"), ("correction", 1)):
        others = {**facts(0), name: other}
        assert store.past.checkpoints.nearest(NOW_NS + 3 * HOUR_NS, lambda _, others=others: others, 3) is None
    (tmp_path / "other").mkdir()
    with closing(PastStore(tmp_path / "other")) as other:
        other.add(random_samples(20, 1))
        shutil.copytree(store.past.checkpoints.folder, other.past.checkpoints.folder)
        assert nearest(other, 3) is None


def test_one_of_rows_that_the_journal_has_not_is_not_used_and_removed_at_the_start(store, tmp_path, caplog):
    assert [nearest(store, 3, last_row=row) for row in (3, 2, 1, 0)] == [3, 2, 1, None]
    remove_beyond(tmp_path, 2)
    assert nearest(store, 3, last_row=99) == 2
    assert "checkpoint removed" in caplog.text
    assert "2026-01-01T03" in caplog.text


def test_a_file_under_another_name_is_not_what_its_name_says(store):
    path = store.past.checkpoints.path(NOW_NS + HOUR_NS)
    shutil.copy(path, store.past.checkpoints.path(NOW_NS + 4 * HOUR_NS))
    for name in ("2026-13-45T99.checkpoint", "notes.txt", ".2026-01-01T05.checkpoint.12.part"):
        shutil.copy(path, path.with_name(name))
    assert nearest(store, 90) == 3
    assert len(store.past.checkpoints.entries(lambda _: {}, 3)) == 4
    assert store.past.checkpoints.passed_over == 1


def test_a_look_says_what_there_is(store):
    checkpoints = store.past.checkpoints
    assert checkpoints.state == {"count": 0, "bytes": 0, "newest_ns": 0, "passed_over": 0}
    size = sum(path.stat().st_size for path in checkpoints.folder.iterdir())
    checkpoints.look(store.past.depends_on(store.reader, NO_FACTS), 2)
    assert checkpoints.state == {"count": 2, "bytes": size, "newest_ns": NOW_NS + 2 * HOUR_NS, "passed_over": 0}


HEADER = Header(7200, 41, {"store": "x", "excluded": ["a"]}, 3, 4, 5, 6)


def written(path: Path, state: GridState) -> Path:
    with path.open("wb") as file:
        writer = CheckpointWriter(file)
        for x, y, pages in state.blocks:
            writer.add(x, y, pages)
        writer.finish(HEADER)
        assert file.tell() == writer.bytes_written
    return path


def read(path: Path, window: CellWindow | None = None) -> Grid:
    with Checkpoint(path) as checkpoint:
        blocks = tuple(checkpoint.blocks(checkpoint.numbers_in(window)))
        return Grid.from_state(1.0, FoldConfig(), GridState(blocks, 0, 0, 0, 0))


@pytest.fixture(scope="module")
def state() -> GridState:
    return folded(random_samples(300, 3)).state()


@pytest.mark.parametrize("count", [None, 2**16, 2**32 - 1])
def test_what_is_written_is_read(tmp_path, state, count):
    state = filled_to(state, count) if count else state
    path = written(tmp_path / "one", state)
    with Checkpoint(path) as checkpoint:
        assert checkpoint.header == HEADER
        assert len(checkpoint.index) == len(state.blocks)
    assert same(read(path), Grid.from_state(1.0, FoldConfig(), GridState(state.blocks, 0, 0, 0, 0)))


@pytest.mark.parametrize("window", [(-16, -16, 32, 32), (0, 0, 1, 1), (-1, 15, 2, 2), (500, 500, 9, 9)])
def test_the_blocks_of_a_window_are_read_alone(tmp_path, state, window):
    column, row, columns, rows = window
    path = written(tmp_path / "one", state)
    got = [(x, y) for x, y, _ in read(path, CellWindow(*window)).state().blocks]
    assert got == [
        (x, y)
        for x, y, _ in state.blocks
        if column < 16 * (x + 1) and 16 * x < column + columns and row < 16 * (y + 1) and 16 * y < row + rows
    ]


def test_no_flipped_bit_is_believed(tmp_path, state):
    seed = 5
    path = written(tmp_path / "one", GridState(state.blocks[:2], 0, 0, 0, 0))
    data, good = path.read_bytes(), read(path)
    draw = np.random.default_rng(seed)
    at = {*draw.integers(0, len(data), 100).tolist(), *range(len(data) - 300, len(data)), *range(len(MAGIC))}
    for place in at:
        flipped = bytearray(data)
        flipped[place] ^= 1 << int(draw.integers(8))
        path.write_bytes(flipped)
        try:
            got = read(path)
        except DamagedError:
            continue
        assert same(got, good), f"seed {seed}, byte {place}"
        assert place < len(MAGIC), "only the first bytes say nothing that anybody uses"


@pytest.mark.parametrize("keep", [0, 3, 100, -1, -30, -5000])
def test_a_file_that_was_cut_is_damaged(tmp_path, state, keep):
    path = written(tmp_path / "one", state)
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(DamagedError):
        read(path)


@pytest.mark.parametrize("data", [b"", b"SGCHECK1", b"x" * 5000, b"SGCHECK1" + bytes(200) + b"SGCHECK1"])
def test_a_foreign_file_is_damaged(tmp_path, data):
    (tmp_path / "one").write_bytes(data)
    with pytest.raises(DamagedError, match=r"one: its (end|header) is damaged; it is made again"):
        Checkpoint(tmp_path / "one")


pytest.importorskip("pyarrow.parquet")
HOURS = 4


@pytest.fixture
def empty_store(tmp_path):
    with closing(PastStore(tmp_path)) as opened:
        yield opened


def some_samples(seed: int, n: int = 40, first_h: float = 0.0, hours: float = HOURS):
    """Samples of some hours in any order, a few exactly at full hours."""
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
@settings(max_examples=10, deadline=None)
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


@pytest.mark.parametrize("spill", [50, 10**6])
def test_memory_is_bounded_by_parts_that_go_to_disk(empty_store, monkeypatch, spill):
    monkeypatch.setattr(making, "SPILL_SAMPLES", spill)
    for seed in range(6):
        empty_store.add(some_samples(seed), "ab"[seed % 2])
    empty_store.archive(3)
    empty_store.make(NOW_NS + 3 * HOUR_NS)
    with Checkpoint(empty_store.past.checkpoints.path(NOW_NS + 3 * HOUR_NS)) as checkpoint:
        assert same(empty_store.past.grid(checkpoint), empty_store.folded(NOW_NS + 3 * HOUR_NS - 1))
    assert [path.name for path in empty_store.past.checkpoints.folder.iterdir()] == ["2026-01-01T03.checkpoint"]


@pytest.mark.parametrize("steps", [1, 2])
def test_one_that_is_given_up_leaves_what_was_there(empty_store, steps, monkeypatch):
    monkeypatch.setattr(making, "SPILL_SAMPLES", 30)
    empty_store.add(some_samples(1))
    empty_store.make(NOW_NS + HOUR_NS)
    before = {path.name: path.read_bytes() for path in empty_store.past.checkpoints.folder.iterdir()}
    empty_store.add(some_samples(2), "b")
    running = make(empty_store.past, empty_store.reader, NOW_NS + HOUR_NS, NO_FACTS)
    for _ in range(steps):
        next(running)
    running.close()
    assert {path.name: path.read_bytes() for path in empty_store.past.checkpoints.folder.iterdir()} == before


def test_damage_in_what_it_begins_with_is_found_and_the_next_attempt_does_without(empty_store):
    empty_store.add(some_samples(1))
    empty_store.make(NOW_NS + HOUR_NS)
    path = empty_store.past.checkpoints.path(NOW_NS + HOUR_NS)
    data = bytearray(path.read_bytes())
    data[100] ^= 1
    path.write_bytes(data)
    with pytest.raises(DamagedError, match="a block is damaged; it is made again"):
        empty_store.make(NOW_NS + 2 * HOUR_NS)
    assert empty_store.past.checkpoints.passed_over == 1
    empty_store.make(NOW_NS + 2 * HOUR_NS)
    assert same(empty_store.as_of(NOW_NS + 2 * HOUR_NS), empty_store.folded(NOW_NS + 2 * HOUR_NS))


DAY = 20_000 * DAY_NS


def next_stamp(*stamps: int):
    return lambda from_ns: min((stamp for stamp in stamps if stamp >= from_ns), default=None)


def at(days: float, hours: float = 0.0) -> int:
    return DAY + round(days * DAY_NS) + round(hours * HOUR_NS)


@pytest.mark.parametrize(
    ("now", "usable", "stamps", "expected"),
    [
        (at(0, 9.5), [], [at(0, 8.2)], at(0, 9)),  # first full hour after the first sample
        (at(0, 9), [], [at(0, 8.2)], None),  # an hour ends when its latest samples are in
        (at(0, 9) + GRACE_NS, [], [at(0, 8.2)], at(0, 9)),
        (at(0, 9) + GRACE_NS - 1, [], [at(0, 8.2)], None),
        (at(0, 12.5), [at(0, 9)], [at(0, 8.2), at(0, 11.1)], at(0, 12)),  # none for an empty hour
        (at(0, 12.5), [at(0, 9)], [at(0, 9)], at(0, 10)),  # a full hour's stamp belongs to the next
        (at(0, 12.5), [at(0, 9)], [at(0, 9) - 1], None),
        (at(3, 12.5), [], [at(0, 8.2), at(1, 9)], at(1)),  # older than a day: by days
        (at(3, 12.5), [at(1)], [at(0, 8.2), at(1, 9)], at(2)),
        (at(3, 12.5), [at(0, 18)], [at(2, 13)], at(2, 14)),  # within the last day: by hours
        (at(3, 12.5), [at(0, 18)], [at(2, 12.4)], at(2, 13)),
        (at(3, 12.5), [at(0, 18)], [at(2, 11)], at(2, 12)),  # the following hours too
        (at(0, 9.5), [], [], None),
    ],
)
def test_hours_of_the_last_day_and_days_before(now, usable, stamps, expected):
    assert due(now, usable, [], next_stamp(*stamps)) == expected


def test_what_cannot_be_used_is_made_again_oldest_first():
    stamps = next_stamp(*range(at(0), at(1, 12), HOUR_NS))
    assert due(at(1, 12), [at(0, 20)], [at(1, 3), at(0, 10)], stamps) == at(0, 10)
    assert due(at(1, 12), [at(0, 10), at(0, 20)], [at(1, 3)], stamps) == at(1, 3)
    assert due(at(1, 12), [at(1, 11)], [at(1, 12)], stamps) is None, "not over yet"


def test_one_in_the_future_was_closed_by_a_wrong_clock():
    assert surplus(at(0, 12), [at(0, 11), at(5)]) == [at(5)]


@given(
    st.lists(st.tuples(st.integers(0, 2000), st.integers(1, 100)), unique_by=lambda pair: pair[0]), st.integers(0, 999)
)
def test_room_is_made_within_the_limit_and_the_newest_goes_last(pairs, most):
    sizes = {at(0, hour): size for hour, size in pairs}
    gone = thinned(at(0), at(0, 2001), sizes, most)
    kept = set(sizes) - set(gone)
    assert sum(sizes[each] for each in kept) <= most
    assert len(gone) == len(set(gone))
    if kept:
        assert max(sizes) in kept
    if gone:
        assert sum(sizes[each] for each in [*kept, gone[-1]]) > most, "one too many was removed"


def test_steps_grow_with_age():
    days = [at(day) for day in range(100)]
    gone = thinned(at(0, -8), at(100), dict.fromkeys(days, 1), 20)
    kept = sorted(set(days) - set(gone))
    steps = [(later - earlier) / DAY_NS for earlier, later in pairwise(kept)]
    assert steps[-1] == 1
    assert max(steps[:4]) > 3 * max(steps[-4:])
    relative = [step / (100 - (closed - DAY) / DAY_NS) for step, closed in zip(steps, kept, strict=False)]
    assert max(relative[:-3]) < 0.3
