"""Long folds of a history: threads that read ahead, ends before the end."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import closing
from itertools import count
from pathlib import Path

import pytest

from mapserver.evidence.grid import Grid
from mapserver.journal import history as refold
from mapserver.journal.history import AHEAD, History, ahead, fold_history
from mapserver.journal.location import JOURNAL_FILE
from mapserver.journal.rows import Selection
from mapserver.journal.sqlite.reader import SqliteReader
from tests.journals import history_beside
from tests.unit.mapserver.data import CONFIG, SITE, incoming, open_store, random_samples, same


@pytest.fixture
def history(tmp_path: Path) -> Iterator[History]:
    """Three machines, 20 rows of 25 samples each."""
    with closing(open_store(tmp_path)) as store:
        for number in range(20):
            store.commit([incoming(rows_of(name, number), 1 + 25 * number, name) for name in "abc"])
    with SqliteReader(tmp_path / JOURNAL_FILE) as reader:
        yield history_beside(reader)


def rows_of(machine: str, number: int):
    return random_samples(25, seed=100 * "abc".index(machine) + number)


def expected(machines: str) -> Grid:
    grid = Grid(SITE.cell_m, CONFIG.fold)
    for name in machines:
        for number in range(20):
            grid.fold(rows_of(name, number), name)
    return grid


@pytest.mark.parametrize("piece", [7, 16_384])
@pytest.mark.parametrize("threads", [1, 2, 3])
def test_a_history_folded_by_any_threads_is_the_fold_of_its_rows(history, monkeypatch, threads, piece):
    monkeypatch.setattr(refold, "PIECE", piece)
    grid = Grid(SITE.cell_m, CONFIG.fold)
    without_b = Selection(without=frozenset("b"))
    assert fold_history(grid, history, until=30, selection=without_b, threads=threads)
    assert fold_history(grid, history, after=30, selection=without_b, threads=threads)
    assert same(grid, expected("ac"))


@pytest.mark.parametrize("threads", [1, 2])
def test_a_fold_that_is_stopped_ends_at_once_and_says_so(history, monkeypatch, threads):
    monkeypatch.setattr(refold, "PIECE", 10)
    asked = count()
    grid = Grid(SITE.cell_m, CONFIG.fold)
    assert not fold_history(grid, history, stopped=lambda: next(asked) == 3, threads=threads)
    assert next(asked) == 4
    assert not [thread for thread in threading.enumerate() if thread.name.startswith(("fold", "read"))]


def test_what_is_made_ahead_comes_in_order_and_no_more_is_made_than_that():
    made = []

    def numbers() -> Iterator[int]:
        for number in count(1):
            made.append(number)
            yield number

    with closing(ahead(numbers())) as coming:
        assert [next(coming) for _ in range(50)] == list(range(1, 51))
    assert len(made) <= 50 + AHEAD
    assert list(ahead(iter(range(1, 40)))) == list(range(1, 40))


def test_an_error_of_what_is_made_ahead_comes_in_its_place():
    def numbers() -> Iterator[int]:
        yield from (1, 2)
        raise OSError("the disk")

    coming = ahead(numbers())
    assert (next(coming), next(coming)) == (1, 2)
    with pytest.raises(OSError, match="the disk"):
        next(coming)
