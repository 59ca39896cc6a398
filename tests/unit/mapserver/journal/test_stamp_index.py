"""An index of stamps: no row with a selected stamp is passed over, and most others are."""

import tempfile
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapserver.journal import stamp_index
from mapserver.journal.rows import LAST, Selection
from mapserver.journal.sqlite.journal import SqliteJournal
from mapserver.journal.sqlite.reader import SqliteReader
from mapserver.journal.stamp_index import StampIndex
from tests.unit.mapserver.data import NOW_NS, SITE, batch, put, samples

S = 10**9


@pytest.fixture(autouse=True)
def small_chunks(monkeypatch):
    monkeypatch.setattr(stamp_index, "CHUNK", 4)


def append(journal: SqliteJournal, first_s: int, last_s: int) -> None:
    stamps = NOW_NS + np.array([first_s, last_s]) * S
    put(journal, batch(samples(2, stamp_ns=stamps), 1 + 2 * journal.last_row))


def inside(stretches, last: int) -> list[int]:
    return [row for first, end in stretches for row in range(first + 1, min(end, last) + 1)]


ROWS = st.lists(st.tuples(st.integers(0, 40), st.integers(0, 6)), min_size=1, max_size=25)


@pytest.mark.slow
@settings(max_examples=20, deadline=None)
@given(
    rows=ROWS, cut=st.integers(0, 25), archived=st.integers(0, 25), begin=st.integers(-1, 50), length=st.integers(0, 20)
)
def test_no_selected_row_is_passed_over(rows, cut, archived, begin, length):
    selection = Selection(NOW_NS + begin * S, NOW_NS + (begin + length) * S)
    with tempfile.TemporaryDirectory() as folder:
        journal = SqliteJournal(Path(folder) / "journal.db", SITE.name, SITE.frame)
        with closing(journal), SqliteReader(journal.path) as reader:
            index = StampIndex()
            for number, (first, more) in enumerate(rows, start=1):
                append(journal, first, first + more)
                if number == cut:
                    list(index.stretches(reader, 0, LAST, selection))
                    journal.forget(archived)
            archived_row = journal.archived_row
            for after, until in ((0, LAST), (3, 9), (8, 8), (archived_row, len(rows))):
                got = inside(index.stretches(reader, after, until, selection), len(rows))
                assert got == sorted(set(got))
                for number, (first, more) in enumerate(rows, start=1):
                    wanted = after < number <= until
                    if number <= archived_row or (first <= begin + length and first + more >= begin):
                        assert (number in got) == wanted
                    assert wanted or number not in got
            left = [(first, first + more) for first, more in rows[archived_row:]]
            next_s = min((max(first, begin) for first, last in left if last >= begin), default=None)
            expected = None if next_s is None else NOW_NS + next_s * S
            assert index.next_stamp(reader, NOW_NS + begin * S) == expected
