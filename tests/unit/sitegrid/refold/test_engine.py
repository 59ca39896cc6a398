"""Tasks in processes that may die, hang or fail, and that end with their parent."""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys
from pathlib import Path

import pytest

from protocol.errors import SitegridError
from sitegrid.process.children import wait_until
from sitegrid.refold import engine
from sitegrid.refold.engine import Cluster, EngineError, Here
from tests.patience import PATIENCE_S
from tests.unit.sitegrid.refold.tasks import die, die_once, fail, hang, square

pytestmark = [pytest.mark.processes, pytest.mark.nightly]


def running() -> list[int]:
    """Running children: multiprocessing lists ones already awaited by other threads."""
    return [child.pid for child in multiprocessing.active_children() if child.pid and _runs(child.pid)]


def test_tasks_are_done_in_their_order_by_processes_of_their_own() -> None:
    done: list[int] = []
    with Cluster(jobs=2) as two:
        results = two.each(square, range(20), done.append)
        again = two.each(square, [3])
    assert [value for value, _ in results] == [n * n for n in range(20)]
    assert sorted(done) == list(range(20))
    pids = {pid for _, pid in [*results, *again]}
    assert 1 <= len(pids) <= 2, "the same ones"
    assert os.getpid() not in pids
    assert not running()
    assert Here(1).each(square, [2, 3]) == [(4, os.getpid()), (9, os.getpid())]


def test_a_process_that_is_killed_is_replaced(tmp_path: Path) -> None:
    with Cluster(jobs=2) as two:
        pids = two.each(die_once, [tmp_path / str(n) for n in range(3)])
    assert len(pids) == 3
    assert len(list(tmp_path.iterdir())) == 3


def test_processes_that_always_die_end_the_work() -> None:
    with Cluster(jobs=2) as two, pytest.raises(EngineError, match="died of one task, 3 times in a row; if that"):
        two.each(die, range(4))
    assert not running()


def test_processes_that_hang_end_the_work(monkeypatch) -> None:
    monkeypatch.setattr(engine, "PATIENCE_S", 1.0)
    monkeypatch.setattr(engine, "TRIES", 1)
    with Cluster(jobs=1) as one, pytest.raises(EngineError, match="did nothing for 1 s"):
        one.each(hang, [1])
    assert not running(), "they are killed"


def test_an_error_of_a_task_is_that_of_the_work() -> None:
    with Cluster(jobs=1) as one, pytest.raises(SitegridError, match="/a/file: is damaged 5"):
        one.each(fail, [5])
    assert not running()


def test_processes_end_with_who_started_them() -> None:
    """A killed parent cannot end them."""
    code = (
        "import multiprocessing, time; from sitegrid.refold.engine import Cluster\n"
        "from tests.unit.sitegrid.refold.tasks import square\n"
        "if __name__ == '__main__':\n"
        "    pool = Cluster(jobs=2).__enter__(); pool.each(square, range(4))\n"
        "    print(*(child.pid for child in multiprocessing.active_children()), flush=True); time.sleep(1000)\n"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout
        pids = [int(word) for word in parent.stdout.readline().split()]
        parent.kill()
    assert pids
    wait_until(lambda: not any(_runs(pid) for pid in pids), PATIENCE_S, "the end of the processes")


def _runs(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False
