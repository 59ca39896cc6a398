"""The soak in short; in full: `make soak`."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.soak import Look, Soak, main, soak

pytestmark = pytest.mark.processes


def seen(*server_mib: float) -> Soak:
    looks = (Look(i + 1.0, 100 * i, {"server": mib, "router": 40.0}) for i, mib in enumerate(server_mib))
    return Soak(tuple(looks), 1000, 0.0)


@pytest.mark.nightly
def test_half_an_hour_of_work_leaves_the_memory_flat(tmp_path: Path):
    result = soak(tmp_path, minutes=30, speed=200, machines=4)
    assert [round(look.minute) for look in result.looks] == list(range(1, 31))
    assert result.looks[-1].samples == result.sent == 4 * 30 * 150
    assert result.growth_pct() < 10, "looks scatter by 10 %, medians of ten by 4"


def test_growth_is_that_of_the_last_third():
    assert seen(*[100.0] * 6, *[104.0] * 3).growth_pct() == pytest.approx(4.0)
    assert seen(*[50.0] * 3, *[100.0] * 6).growth_pct() == 0.0
    assert seen(*[100.0] * 7, 300.0, 300.0).growth_pct() == pytest.approx(200.0)
    assert seen(*[100.0] * 8, 300.0).growth_pct() == 0.0, "one look is not growth"
    assert seen(*range(100, 190, 10)).growth_pct() == pytest.approx(100 * (170 / 140 - 1)), "what leaks all along shows"


@pytest.mark.parametrize(("last", "code"), [(104.9, 0), (105.1, 1)])
def test_memory_that_grows_is_a_failure(last: float, code: int, monkeypatch: pytest.MonkeyPatch, capsys):
    monkeypatch.setattr("tests.soak.soak", lambda *_, **__: seen(*[100.0] * 10, *[last] * 5))
    assert main(["--json"]) == code
    lines = capsys.readouterr().out.splitlines()
    assert json.loads(lines[-1])["growth_pct"] == pytest.approx({"server": last - 100, "router": 0.0}, abs=0.01)
    assert "of resident memory: server +" in lines[-2]
