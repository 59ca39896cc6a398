"""Worker processes: of one thread, without traces in this process, and gone when it ends."""

import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from lab.campaign.workers import each
from protocol.errors import ConfigError, SitegridError


def test_jobs_run_in_processes_of_one_thread_and_leave_no_trace(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    values = dict(each(os.getenv, ["OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"], processes=2))
    assert values == {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    assert "OMP_NUM_THREADS" not in os.environ


@pytest.mark.parametrize("processes", [1, 2])
def test_an_error_in_a_job_ends_the_run(processes: int):
    with pytest.raises(ValueError, match="invalid literal"):
        list(each(int, ["1", "x", "2"], processes))


def _refuse(place: str) -> None:
    raise ConfigError(place, "is wrong")


@pytest.mark.parametrize("processes", [1, 2])
def test_an_error_of_ours_comes_back_with_its_message(processes: int):
    with pytest.raises(SitegridError, match=r"^a.toml: is wrong$"):
        list(each(_refuse, ["a.toml", "a.toml"], processes))


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="looks at /proc")
def test_workers_end_with_a_parent_that_is_killed():
    code = "import time; from lab.campaign.workers import each\nlist(each(time.sleep, [90, 90], 2))"
    parent = subprocess.Popen([sys.executable, "-c", code])
    listed = Path(f"/proc/{parent.pid}/task/{parent.pid}/children")
    workers = wait_for(lambda: pids if len(pids := listed.read_text().split()) >= 3 else None)
    wait_for(lambda: all(len(list(Path(f"/proc/{w}/task").iterdir())) > 1 for w in workers[1:]))  # they watch
    parent.kill()
    parent.wait()
    assert wait_for(lambda: not any(is_alive(worker) for worker in workers))


def is_alive(pid: str) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


def wait_for(condition: Callable[[], Any]) -> Any:
    """What the condition returns once it is true."""
    deadline = time.monotonic() + 30
    pause = threading.Event()
    while not (value := condition()):
        assert time.monotonic() < deadline, "nothing happened for 30 s"
        pause.wait(0.05)
    return value
