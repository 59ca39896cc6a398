import json

import pytest

from lab.speed.__main__ import main
from lab.speed.web import pages as web

IN_BROWSERS = {"change to paint, 95 % [ms]", "first paint [ms]", "first paint [kB]"}


@pytest.mark.processes
def test_web_measures_real_servers_with_pages_open_and_machines_at_work(capsys, monkeypatch) -> None:
    monkeypatch.setattr(web, "CHROMIUM", None)
    monkeypatch.setattr(web, "MANY", 12)
    monkeypatch.setattr(web, "TILES", 5)
    assert main(["web", "--json", "--hours", "0.2", "--seconds", "4"]) == 0
    output = capsys.readouterr()
    result = json.loads(output.out)
    assert (result["benchmark"], result["seconds"]) == ("web", 4.0)
    values = {row["measured"]: row["value"] for row in result["rows"]}
    assert set(values) == web.GOALS.keys() - IN_BROWSERS
    assert all(row["goal"] == web.GOALS[row["measured"]] for row in result["rows"])
    assert result["missing"].keys() == IN_BROWSERS
    assert "not measured: first paint [ms]; install Chromium" in output.err
    assert 0 < values["web server, five pages [% of a core]"] < 100
    assert values["map server, for five pages [ms/s]"] >= 0
    assert 0 < values["XYZ tile, cached, 95 % [ms]"] <= values["XYZ tile, fresh, 95 % [ms]"]
    assert 0 < values["pages behind the map, most [ms]"] < 10_000


def test_a_page_is_behind_each_change_until_it_has_its_row() -> None:
    changes = [(1000.0, 5), (2000.0, 8), (3000.0, 9)]
    seen = [(900.0, 2), (1100.0, 5), (2300.0, 8)]
    assert web._behind(changes, seen) == [100.0, 300.0]  # the last one it has not seen yet
    assert web._behind(changes, [(500.0, 9)]) == [0.0, 0.0, 0.0]
