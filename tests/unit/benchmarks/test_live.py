import json

import numpy as np
import pytest

from benchmarks import live
from benchmarks.__main__ import main
from benchmarks.merge_work import SAMPLE_NS, batches


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


def test_a_second_has_what_ten_machines_drive_in_it() -> None:
    seconds = live._seconds(batches())
    first = next(seconds)
    assert len({name for name, _ in first}) == len(first) == 10
    assert {len(rows) for _, rows in first} == {6}
    assert max(int(np.ptp(rows["stamp_ns"])) for _, rows in first) == 5 * SAMPLE_NS < 10**9
    leg = [first, *(next(seconds) for _ in range(83))]
    assert sum(len(rows) for second in leg for _, rows in second) == 10 * 500
