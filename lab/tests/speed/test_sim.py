import json
import math

import pytest

from lab.speed import sim
from lab.speed.__main__ import main

SMALL = (sim.FleetCase("paper_site", "pybullet", 2, 20.0), sim.FleetCase("busy_site", "fast", 3, 40.0))


def test_goals_stand_beside_their_fleets() -> None:
    goals = {(case.world, case.machines): case.goal for case in sim.CASES}
    slow = {("pybullet", 1): 25.0, ("pybullet", 4): 20.0, ("pybullet", 8): 15.0, ("pybullet", 32): 8.0}
    assert goals == slow | {("fast", 100): 40.0, ("fast", 1000): 12.0}


@pytest.mark.slow
def test_sim_prints_one_json_object_with_a_row_for_every_fleet(monkeypatch, capsys) -> None:
    monkeypatch.setattr(sim, "CASES", SMALL)
    assert main(["sim", "--json", "--seconds", "0.5", "--runs", "2"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert (result["benchmark"], result["seconds"], result["runs"]) == ("sim", 0.5, 2)
    rows = result["rows"]
    assert [(r["world"], r["machines"], r["give_way"]) for r in rows] == [("pybullet", 2, True), ("fast", 3, False)]
    assert [row["goal"] for row in rows] == [20.0, 40.0]
    figures = [row[name] for row in rows for name in ("sim_seconds_per_cpu_second", "start_up_cpu_s")]
    assert all(math.isfinite(figure) and figure > 0 for figure in figures)
