import dataclasses
import sys
import tomllib

import pytest

from protocol.errors import ConfigError
from sim.config import SimConfig, load_sim, resolve
from tests.paths import CONFIG

EXAMPLE = CONFIG / "sim.toml"


def test_example_has_the_defaults_and_names_every_option() -> None:
    assert load_sim(EXAMPLE) == SimConfig()
    text = EXAMPLE.read_text()
    shown = "\n".join(line.removeprefix("# ") for line in text.splitlines() if " = " in line)
    assert set(tomllib.loads(shown)) == {f.name for f in dataclasses.fields(SimConfig)}


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("site", "Paper/*"),
        ("names", ("a", "*", "b")),
        ("machines", 0),
        ("speed", -0.5),
    ],
)
def test_bad_option_is_refused_by_name(name: str, value: object) -> None:
    with pytest.raises(ValueError, match=name):
        SimConfig(**{name: value})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        ({"scenario": "mars"}, "there is no 'mars'; known: bad_machine, busy_site"),
        ({"world": "flat"}, "world: 'flat' is neither pybullet nor fast"),
        ({"names": ("a", "b")}, "names: 2 names for 3 machines"),
        ({"names": ("a", "a", "b")}, "two machines are named 'a'"),
        ({"seed": -1}, "seed, seconds: negative"),
        ({"drive_mps": 0.1}, "drive_mps: 0.1 is not between"),
        ({"gps": (4,)}, "gps.*4"),
    ],
)
def test_option_that_does_not_fit_the_scenario_is_refused(options: dict, problem: str) -> None:
    with pytest.raises(ConfigError, match=problem) as caught:
        resolve(SimConfig(**options))
    assert "\n" not in str(caught.value)


def test_options_go_over_the_scenario() -> None:
    run = {"site": "pit", "world": "fast", "machines": 2, "names": ("red", "blue"), "seed": 9, "seconds": 5.0}
    sensors = {"preset": "rtk", "gps": (3,), "imu": (1, 4), "attitude": (4,), "payload": True}
    scenario = resolve(SimConfig(drive_mps=2.0, **run, **sensors))
    assert (scenario.site.name, scenario.world, scenario.seed, scenario.seconds) == ("pit", "fast", 9, 5.0)
    assert scenario.machine_names == ("red", "blue")
    assert {rig.preset.name for rig in scenario.rigs()} == {"rtk"}
    assert {speed for _, speed, _ in scenario.journeys()} == {2.0}
    names = {s.name for s in scenario.rigs()[0].machine.sensors}
    assert names == {"gps-3", "imu-1", "imu-4", "attitude-4", "torque", "wheels", "articulation", "payload"}


def test_without_pybullet_the_fast_world_takes_its_place_and_says_so(monkeypatch, caplog) -> None:
    assert resolve(SimConfig("haul_road")).world == "pybullet"
    monkeypatch.setitem(sys.modules, "pybullet", None)
    assert resolve(SimConfig("haul_road", world="pybullet")).world == "pybullet"  # fails later, in one line
    assert not caplog.records
    assert resolve(SimConfig("haul_road")).world == "fast"
    assert "the fast world takes the place of PyBullet" in caplog.text
