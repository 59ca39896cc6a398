"""The soak in short; the hour is `python -m tests.soak --minutes 60 --speed 30`."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.soak import Look, Soak, SoakMachine, main, soak

pytestmark = pytest.mark.processes


def seen(*server_mib: float) -> Soak:
    return Soak(tuple(Look(i + 1.0, 100 * i, mib, 40.0) for i, mib in enumerate(server_mib)), 1000, 0.0)


def test_ten_minutes_of_work_leave_the_memory_flat(tmp_path: Path):
    result = soak(tmp_path, minutes=10, speed=75, machines=4)
    assert [round(look.minute) for look in result.looks] == list(range(1, 11))
    assert result.looks[-1].samples == result.sent == 4 * 10 * 150
    assert result.growth_pct() < 10, "in the first minutes everything is still being used for the first time"


def test_growth_is_that_of_the_second_half():
    assert seen(*[100.0] * 10, *[104.0] * 10).growth_pct() == pytest.approx(4.0)
    assert seen(*[50.0] * 5, *[100.0] * 15).growth_pct() == 0.0
    assert seen(*[100.0] * 19, 300.0).growth_pct() == 100.0
    assert seen(*[100.0] * 10, *[101.0] * 8, *[90.0] * 2).growth_pct() == pytest.approx(-10.0)


@pytest.mark.parametrize(("last", "code"), [(104.9, 0), (105.1, 1)])
def test_memory_that_grows_is_a_failure(last: float, code: int, monkeypatch: pytest.MonkeyPatch, capsys):
    monkeypatch.setattr("tests.soak.soak", lambda *_: seen(*[100.0] * 10, *[last] * 10))
    assert main(["--json"]) == code
    lines = capsys.readouterr().out.splitlines()
    assert json.loads(lines[-1])["growth_pct"] == pytest.approx(last - 100, abs=0.01)
    assert "% of resident memory" in lines[-2]


def test_a_machine_drives_on_where_it_was():
    one, other = SoakMachine("a", 1), SoakMachine("a", 1)
    first = one.drive(0.0, "frame")
    assert first == other.drive(0.0, "frame")
    assert one.drive(4.0, "frame") != first
