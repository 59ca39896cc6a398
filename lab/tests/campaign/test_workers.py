"""Worker processes: single-threaded, isolated, gone at the end."""

import os

import pytest

from lab.campaign.workers import each
from protocol.errors import ConfigError, SitegridError


def test_jobs_run_in_processes_of_one_thread_and_leave_no_trace(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    values = dict(each(os.getenv, ["OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"], processes=2))
    assert values == {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    assert "OMP_NUM_THREADS" not in os.environ


def _refuse(place: str) -> None:
    raise ConfigError(place, "is wrong")


@pytest.mark.parametrize("processes", [1, 2])
def test_an_error_of_ours_comes_back_with_its_message(processes: int):
    with pytest.raises(SitegridError, match=r"^a.toml: is wrong$"):
        list(each(_refuse, ["a.toml", "a.toml"], processes))
