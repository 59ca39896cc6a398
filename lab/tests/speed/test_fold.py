"""The benchmark of long folds: small journals, and a decision about a machine of a real server."""

from __future__ import annotations

import json

import pytest

from lab.speed import fold, merge_restart
from lab.speed.__main__ import main

pytestmark = pytest.mark.processes


def test_fold_measures_journals_with_one_thread_and_two_and_a_decision(capsys, monkeypatch):
    monkeypatch.setattr("lab.speed.fold_decision.QUIET_S", 0.5)
    monkeypatch.setattr("lab.speed.past.HISTORY_ROWS", 50)
    assert main(["fold", "--json", "--hours", "0.05", "--samples", "3000", "--runs", "1"]) == 0
    printed = capsys.readouterr()
    result = json.loads(printed.out)
    names = ("journal", "samples_in_row", "threads")
    expected = [("day", 100, 1), ("day", 100, 2), ("long", 6, 1), ("long", 6, 2), ("long", 100, 1), ("long", 100, 2)]
    assert [tuple(row[name] for name in names) for row in result["rows"]] == expected
    for row in result["rows"]:
        assert 2900 <= row["samples"] <= 10_000
        assert row["cpu_s"] >= 0
        assert row["peak_mb"] > 50
        assert row["faster"] == 1.0 or row["threads"] == 2
    nothing, distrust, trust = result["decisions"]
    assert [row["decision"] for row in (nothing, distrust, trust)] == ["nothing", "distrust", "trust"]
    assert 0 < nothing["point_ms_median"] <= nothing["point_ms_p99"] <= nothing["point_ms_most"]
    assert nothing["ack_ms_median"] > 0
    assert all(row["wall_s"] > 0 and 50 < row["server_mb"] <= row["peak_mb"] for row in (nothing, distrust, trust))
    asked = ["point, last day", "whole map, last day", "whole map, last month", "history of a point"]
    assert [row["asked"] for row in result["past"]] == asked
    assert "is folded with 2 threads, run 1 of 1" in printed.err


def test_a_fold_that_lacks_samples_is_no_measurement(tmp_path, monkeypatch):
    merge_restart.build(tmp_path, 20, tail_rows=20)
    assert fold.fold_timed(tmp_path, 2)["samples"] == 2000
    monkeypatch.setattr(fold, "fold_history", lambda *_, **__: True)
    with pytest.raises(RuntimeError, match="0 of 2000 samples are in the grid"):
        fold.fold_timed(tmp_path, 2)
