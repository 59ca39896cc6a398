from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from protocol.errors import ConfigError
from sim.scenario.file import FOLDER, load_scenario
from sim.scenario.ground import build_terrain

LIBRARY = sorted(path.stem for path in FOLDER.glob("*.toml"))


def write(folder: Path, text: str, base: str = "paper_site") -> str:
    path = folder / "mine.toml"
    path.write_text((f'base = "{base}"\n' if base else "") + text)
    return str(path)


@pytest.mark.parametrize("name", LIBRARY)
def test_every_scenario_is_sound_and_says_what_it_is(name: str) -> None:
    scenario = load_scenario(name)
    assert len(scenario.description) > 20
    assert len(scenario.rigs()) == len(scenario.journeys()) == len(scenario.machine_names)


def test_paper_tours_cover_all_zones_and_the_slope() -> None:
    scenario = load_scenario("paper_site")
    assert (scenario.ground.width_m, scenario.ground.depth_m) == (200, 150)
    legs = [route.legs[0] for route, _, _ in scenario.journeys()]
    assert all(leg.closed for leg in legs)
    points = np.vstack([leg.points for leg in legs])
    share = np.bincount(build_terrain(scenario.ground, 0).zone(*points.T), minlength=5) / len(points)
    assert share.min() > 0.05, share
    (ramp,) = scenario.ground.ramp
    assert np.degrees(np.arctan(ramp.rise_m / np.hypot(*ramp.run_m))) == pytest.approx(15.0, abs=0.01)
    assert ((points[:, 0] > ramp.foot_m[0]) & (points[:, 0] < ramp.top_m[0])).mean() > 0.05


def test_machines_weigh_their_payload_where_a_route_changes_it_or_as_the_fleet_says(tmp_path: Path) -> None:
    def weigh(name: str) -> list[bool]:
        return ["payload" in {s.kind for s in rig.machine.sensors} for rig in load_scenario(name).rigs()]

    assert weigh("paper_site") == [False] * 3
    assert weigh("haul_road") == [True] * 5
    assert weigh("loading") == [True] * 4
    fleet = '[[fleet]]\nname = "a"\nroutes = ["{}"]\npayload = {}\nmodel = "dump_truck"\n'
    assert weigh(write(tmp_path, fleet.format("west", "true"))) == [True]
    assert weigh(write(tmp_path, fleet.format("haul", "false"), "haul_road")) == [False]


def test_scenario_over_a_base_replaces_key_by_key(tmp_path: Path) -> None:
    mine = load_scenario(write(tmp_path, 'seed = 7\n[[fleet]]\nname = "digger"\nroutes = ["west"]\n'))
    base = load_scenario("paper_site")
    assert (mine.seed, mine.machine_names) == (7, ("digger",))
    assert (mine.ground, mine.route, mine.site) == (base.ground, base.route, base.site)
    waves = load_scenario(write(tmp_path, "[ground]\nundulation_cm3 = 16.0\n"))
    assert waves.ground == replace(base.ground, undulation_cm3=16.0)


def test_fleet_takes_its_routes_in_turn(tmp_path: Path) -> None:
    text = '[[fleet]]\nname = "d"\ncount = 5\nroutes = ["west", "east"]\nstart = 0.1\nother_way = true\n'
    journeys = load_scenario(write(tmp_path, text)).journeys()
    built = {route.name: route.build() for route in load_scenario("paper_site").route}
    lengths = [route.length_m for route, _, _ in journeys]
    assert lengths == [built[name].length_m for name in ("west", "east", "west", "east", "west")]
    assert [round(share, 3) for _, _, share in journeys] == [0.1, 0.1, 0.718, 0.718, 0.336]
    np.testing.assert_array_equal(journeys[2][0].legs[0].points, built["west"].reversed().legs[0].points)
    np.testing.assert_array_equal(journeys[4][0].legs[0].points, built["west"].legs[0].points)


def test_own_preset_changes_single_values_of_a_base(tmp_path: Path) -> None:
    text = '[[preset]]\nname = "mine"\nbase = "dgps"\ngps = { drift_std_m = 2.5 }\n'
    text += '[[fleet]]\nname = "a"\nroutes = ["west"]\npreset = "mine"\n'
    (rig,) = load_scenario(write(tmp_path, text)).rigs()
    library = load_scenario("paper_site").preset("dgps")
    assert rig.preset.gps.drift_std_m == 2.5
    assert rig.preset.gps.white_std_m == library.gps.white_std_m
    assert rig.preset.imu == library.imu


FLEET = '[[fleet]]\nname = "a"\nroutes = ["{route}"]\n'
CHANGE = '[[change]]\nat_s = {at_s}\nsoil = "{soil}"\noutline = [[0, 0], [9, 0], [9, 9]]'
BAD = {
    'world = "mars"': "world: 'mars' is neither pybullet nor fast",
    '[[fleet]]\nname = "a"\nroutes = ["west"]\nspeed = 3': r"fleet\[0\]: unknown key `speed`",
    '[[fleet]]\nname = "a"\nroutes = ["north"]': r"\[\[fleet\]\] \"a\": routes: there is no 'north'; there are west",
    '[[fleet]]\nname = "A b"\nroutes = ["west"]': "name: 'A b' is not a name",
    '[[fleet]]\nname = "a"\nroutes = ["west"]\ncount = 0': "count: 0 is not between 1 and 1000",
    '[[fleet]]\nname = "a"\nroutes = ["west"]\nmodel = "tank"': "\"a\": .*there is no 'tank'; known: dump_truck, skid",
    '[[fleet]]\nname = "a"\nroutes = ["west"]\ngps = [4]': '"a": .*gps.*4',
    '[[fleet]]\nname = "a"\nroutes = ["west"]\n[[fleet]]\nname = "a"\nroutes = ["east"]': "two machines are named 'a'",
    '[[fault]]\nmachine = "loader-9"': "fault: there is no machine 'loader-9'; there are loader-1",
    CHANGE.format(at_s=0.0, soil="sand"): r"change\[0\]: at_s: 0.0 is not positive",
    '[[route]]\nname = "r"\n[[route.leg]]\ncorners = [[30, 30], [60, 30]]\n'
    "[[route.leg]]\ncorners = [[60, 30], [30, 30]]\nreverse = true\n"
    '[[fleet]]\nname = "a"\nroutes = ["r"]\nother_way = true': "other_way: route 'r' is no closed loop",
    '[[preset]]\nname = "x"\nbase = "dgps"\ngps = { drift = 1 }': "drift",
}


@pytest.mark.parametrize("text", BAD, ids=lambda t: t.splitlines()[-1])
def test_bad_scenario_is_refused_in_one_line_with_its_place(tmp_path: Path, text: str) -> None:
    with pytest.raises(ConfigError, match=BAD[text]) as caught:
        load_scenario(write(tmp_path, text))
    assert "\n" not in str(caught.value)
    assert "mine.toml" in str(caught.value)


def leg(corners: str, more: str = "") -> str:
    return f"[[route.leg]]\ncorners = {corners}\n{more}\n"


LAP = "[[30, 30], [90, 30], [90, 90], [30, 90]]"
CYCLES = {
    "corners = [[30, 30], [250, 30], [60, 90]]": r'\[\[route\]\] "r": leaves the map at \(\d+, \d+\): keep 3 m inside',
    "corners = [[30, 30], [60, 30], [60, 60]]\nrounding_m = 1.0": r"'r': the curve at .* radius of .* needs 6.\d m",
    "corners = [[30, 30], [60, 30]]": "corners: 2 are too few",
    leg("[[30, 30], [60, 30]]") + leg("[[65, 30], [30, 30]]", "reverse = true"): "leg 1 ends 5.0 m from where the next",
    leg("[[30, 30], [60, 30]]") + leg("[[60, 30], [30, 30]]"): "turn around with a bend of 180 deg",
    leg("[[30, 30], [60, 30]]") + leg("[[60, 30], [60, 60], [30, 30]]", "reverse = true"): "reverse with a bend of 90",
    leg("[[30, 30], [60, 30]]", "payload_kg = 9000.0")
    + leg("[[60, 30], [30, 30]]", "reverse = true"): "payload_kg: 9000 kg is more than a wheel_loader carries, 5000",
    "": "either corners or legs",
    2 * f'corners = {LAP}\n[[route]]\nname = "r"\n' + f"corners = {LAP}": "two routes are named 'r'",
}


@pytest.mark.parametrize("text", CYCLES, ids=range(len(CYCLES)))
def test_impossible_route_is_refused_with_its_place(tmp_path: Path, text: str) -> None:
    with pytest.raises(ConfigError, match=CYCLES[text]) as caught:
        load_scenario(write(tmp_path, f'[[route]]\nname = "r"\n{text}\n' + FLEET.format(route="r")))
    assert "\n" not in str(caught.value)
    assert "mine.toml" in str(caught.value)


def test_base_that_is_missing_or_goes_in_a_circle_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="is its own base"):
        load_scenario(write(tmp_path, "", "mine.toml"))
    with pytest.raises(ConfigError, match="no such file"):
        load_scenario(write(tmp_path, "", "nowhere"))
    for name, words in (("nowhere", "'nowhere'; known: bad_machine, busy_site"), ("gone.toml", r"gone\.toml")):
        with pytest.raises(ConfigError, match=words):
            load_scenario(name)
