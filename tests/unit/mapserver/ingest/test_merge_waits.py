from concurrent.futures import Future
from contextlib import closing

import pytest

from mapserver.ingest import merge_waits
from mapserver.ingest.merge_waits import MergeWaits
from protocol.errors import QueryError, Refusal
from tests.unit.mapserver.data import WAIT_S


@pytest.fixture
def waits():
    with closing(MergeWaits(5)) as made:
        yield made


def added(waits: MergeWaits, row: int, wait_s: float = WAIT_S) -> Future:
    called: Future[QueryError | None] = Future()
    waits.add(row, wait_s, called.set_result)
    return called


def test_rows_call_back_as_they_are_merged_in_any_order(waits):
    later, sooner = added(waits, 9), added(waits, 7)
    waits.advance(6)
    waits.advance(7)
    assert sooner.result(WAIT_S) is None
    assert not later.done()
    waits.advance(12)
    assert later.result(WAIT_S) is None


def test_a_wait_that_is_over_calls_back_with_an_error_and_leaves_the_others(waits):
    other = added(waits, 9)
    assert added(waits, 8, 0.01).result(WAIT_S).reason == Refusal.AFTER_TIMEOUT
    assert not other.done()


def test_waits_are_bounded_and_room_comes_back(waits, monkeypatch):
    monkeypatch.setattr(merge_waits, "MOST_WAITING", 2)
    first = [added(waits, 6), added(waits, 6)]
    with pytest.raises(QueryError, match="too many queries wait") as caught:
        added(waits, 6)
    assert caught.value.reason == Refusal.OVERLOADED
    assert caught.value.retry_after_s > 0
    assert added(waits, 5).done(), "which waits for nothing"
    waits.advance(6)
    assert [one.result(WAIT_S) for one in first] == [None, None]
    assert not added(waits, 7).done()
