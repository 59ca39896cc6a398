import json

import pytest

from lab.speed import past
from lab.speed.__main__ import main


@pytest.mark.slow
def test_past_asks_for_maps_and_a_history_and_says_what_checkpoints_take(capsys, monkeypatch) -> None:
    monkeypatch.setattr(past, "HISTORY_ROWS", 50)
    assert main(["past", "--json", "--hours", "2", "--runs", "1"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert (result["benchmark"], result["hours"], result["runs"]) == ("past", 2.0, 1)
    assert result["checkpoints"]["count"] == 2
    assert result["checkpoints"]["largest_mb"] > 1
    assert [row["asked"] for row in result["rows"]] == list(past.GOALS_MS)
    for row in result["rows"]:
        assert 0 < row["cpu_ms_median"] <= row["cpu_ms_max"]
        assert row["goal_ms"] == past.GOALS_MS[row["asked"]]
