import json

import pytest

from lab.speed.__main__ import main


@pytest.mark.slow
def test_live_prints_what_each_thread_takes_and_the_sum(capsys) -> None:
    assert main(["live", "--json", "--hours", "0.02", "--seconds", "3"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert (result["benchmark"], result["hours"], result["seconds"]) == ("live", 0.02, 3.0)
    ms = {row["thread"]: row["cpu_ms_per_s"] for row in result["rows"]}
    assert list(ms) == ["writer", "fold", "look", "audit", "snapshot", "sum"]
    assert all(value > 0 for value in ms.values())
    assert ms["sum"] == pytest.approx(sum(value for name, value in ms.items() if name != "sum"), abs=0.01)
    assert {row["thread"]: row["goal"] for row in result["rows"] if row["goal"]} == {"look": 10.0, "sum": 60.0}
