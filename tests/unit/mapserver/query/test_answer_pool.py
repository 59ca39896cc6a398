import threading
from contextlib import closing

import pytest

from mapserver.query.queryable import MIN_RETRY_S, AnswerPool
from protocol.errors import QueryError, Refusal
from tests.patience import PATIENCE_S
from tests.unit.mapserver.data import wait_for


class Held:
    """Work that reports its end and lasts until released."""

    def __init__(self) -> None:
        self.done: list[str] = []
        self._go = threading.Semaphore(0)
        self._begun = threading.Semaphore(0)

    def work(self, name: str):
        def do() -> None:
            self._begun.release()
            assert self._go.acquire(timeout=PATIENCE_S)
            self.done.append(name)

        return do

    def begun(self) -> None:
        assert self._begun.acquire(timeout=PATIENCE_S)

    def let_go(self, n: int) -> None:
        self._go.release(n)


def test_small_answers_pass_large_ones():
    held = Held()
    with closing(AnswerPool("test", 1, 1000)) as pool:
        pool.submit(1, held.work("first"))
        held.begun()
        for name, size in (("large", 500), ("small", 1), ("other", 1)):
            pool.submit(size, held.work(name))
        held.let_go(4)
        wait_for(lambda: len(held.done) == 4)
    assert held.done == ["first", "small", "other", "large"]


def test_small_answers_without_end_do_not_keep_a_large_one_waiting():
    done = threading.Event()
    with closing(AnswerPool("test", 2, 1000)) as pool:

        def small() -> None:
            if not done.is_set():
                pool.submit(1, small)

        for _ in range(4):
            pool.submit(1, small)
        pool.submit(500, done.set)
        assert done.wait(PATIENCE_S)


def test_answers_beyond_the_budget_are_refused_until_some_are_done():
    held = Held()
    with closing(AnswerPool("test", 1, 100)) as pool:
        pool.submit(60, held.work("in work"))
        held.begun()
        pool.submit(40, held.work("waits"))
        with pytest.raises(QueryError, match="too many queries") as caught:
            pool.submit(1, held.work("refused"))
        assert (caught.value.reason, caught.value.retry_after_s) == (Refusal.OVERLOADED, MIN_RETRY_S)
        held.let_go(1)
        held.begun()
        pool.submit(60, held.work("again"))
        held.let_go(2)
        wait_for(lambda: len(held.done) == 3)
    assert held.done == ["in work", "waits", "again"]


def test_a_bug_in_an_answer_costs_neither_thread_nor_budget(caplog):
    held = Held()
    with closing(AnswerPool("test", 1, 1)) as pool:
        pool.submit(1, lambda: 1 // 0)
        wait_for(lambda: not pool._size)
        pool.submit(1, held.work("next"))
        held.let_go(1)
        wait_for(lambda: held.done == ["next"])
    assert "answer failed" in caplog.text


def test_spare_work_is_done_when_it_is_due_or_asked_for_and_answers_come_first():
    held, done = Held(), list[str]()

    def spare() -> float:
        done.append("spare")
        if len(done) == 3:
            raise ZeroDivisionError
        return float("inf")

    with closing(AnswerPool("test", 1, 1000, spare)) as pool:
        wait_for(lambda: done == ["spare"])
        pool.submit(1, held.work("one"))
        held.begun()
        pool.prompt()
        pool.submit(1, lambda: done.append("answer"))
        held.let_go(1)
        wait_for(lambda: len(done) == 3)
        assert done[1] == "answer"
        pool.prompt()
        wait_for(lambda: len(done) == 4)
