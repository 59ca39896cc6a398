import json

import pytest

from lab.speed import roads
from lab.speed.__main__ import main


@pytest.mark.slow
@pytest.mark.processes
def test_roads_are_made_and_a_server_takes_samples_while_it_is_asked(capsys, monkeypatch) -> None:
    monkeypatch.setattr(roads, "WINDOW_S", 0.5)
    assert main(["roads", "--json", "--hours", "1", "--runs", "1", "--seconds", "2"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["km"] == pytest.approx(40, rel=0.02)
    assert [row["made"] for row in result["rows"]] == ["whole", "minute", "worklist"]
    assert all(row["cpu_ms"] > 0 for row in result["rows"])
    ingest = result["ingest"]
    assert min(ingest["samples_per_s"], ingest["samples_per_s_asked"], ingest["answer_s"]) > 0
    assert ingest["lost_pct"] < 100
