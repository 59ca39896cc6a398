"""The benchmark of archives: a small one, folded by every variant."""

from __future__ import annotations

import json

import pytest

from lab.speed.__main__ import main

pytestmark = [pytest.mark.processes, pytest.mark.slow]


def test_archive_measures_threads_processes_and_a_cluster_with_deaths(capsys):
    assert main(["archive", "--json", "--samples", "20000", "--runs", "1"]) == 0
    result = json.loads(capsys.readouterr().out)
    rows = {row["variant"]: row for row in result["rows"]}
    assert list(rows) == ["thread", "threads", "jobs", "dask", "graceful", "segfault"]
    assert len({row["hash"] for row in rows.values()}) == 1
    assert rows["thread"]["faster"] == 1.0
    assert all(row["wall_s"] > 0 and row["cpu_s"] > 0 and row["peak_mb"] > 50 for row in rows.values())
    assert all(row["deaths"] == 0 for row in rows.values() if row["variant"] not in ("graceful", "segfault"))
