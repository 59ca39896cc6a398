from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from protocol.errors import ConfigError
from protocol.files import load_toml
from sim.machines.model import load_model
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


def test_paper_tours_share_ground_in_the_same_direction() -> None:
    """Machines that share a lane must not meet head-on: they cannot pass each other there."""
    routes = {route.name: route.build().legs[0] for route in load_scenario("paper_site").route}
    shared = 0
    for one, other in (("west", "east"), ("east", "middle"), ("west", "middle")):
        a, b = routes[one].points, routes[other].points
        towards = [np.roll(p, -1, axis=0) - p for p in (a, b)]
        gap = np.hypot(*(a[:, None] - b[None]).transpose(2, 0, 1))
        near = np.argwhere(gap < 3.0)
        along = np.array([(towards[0][i] * towards[1][j]).sum() for i, j in near])
        assert (along > -0.5 * 0.25).all(), (one, other)  # crossings, but nothing opposite
        shared += (gap.min(axis=1) < 0.5).sum()
    assert shared > 100


def test_haul_road_is_two_kilometres_and_its_trucks_carry_loads() -> None:
    scenario = load_scenario("haul_road")
    route, speed, _ = scenario.journeys()[0]
    assert route.length_m == pytest.approx(2000, rel=0.03)
    assert {leg.payload_kg for leg in route.legs} == {0.0, 22000.0}
    assert {rig.model.name for rig in scenario.rigs()} == {"dump_truck", "wheel_loader"}
    assert any(leg.reverse for route, _, _ in scenario.journeys() for leg in route.legs)
    assert speed > 5


@pytest.mark.parametrize("name", ["paper_site", "haul_road"])
def test_driven_scenarios_differ_from_their_bases_in_drivers_and_shared_errors_alone(name: str) -> None:
    base, driven = load_scenario(name), load_scenario(f"{name}_driven")
    changed = ("description", "driving", "fleet", "presets")
    assert all(getattr(driven, f.name) == getattr(base, f.name) for f in fields(base) if f.name not in changed)
    for fleet, before in zip(driven.fleet, base.fleet, strict=True):
        assert replace(fleet, preset=before.preset) == before
        gps = driven.preset(fleet.preset).gps
        assert 0.3 <= gps.site_share <= gps.machine_share <= 0.95
    assert driven.driving.wander_m >= 0.3
    assert driven.driving.stop_every_m


def test_busy_site_has_a_hundred_machines_in_the_fast_world_both_ways_round() -> None:
    scenario = load_scenario("busy_site")
    assert (len(scenario.machine_names), scenario.world) == (100, "fast")
    turns = [np.sign(route.legs[0].curvature().sum()) for route, _, _ in scenario.journeys()]
    assert min(turns.count(1), turns.count(-1)) > 30
    shares = np.sort([share for _, _, share in scenario.journeys()][::3])
    assert np.diff(shares).max() < 0.06  # spread over the lap


def test_machines_weigh_their_payload_where_a_route_changes_it_or_as_the_fleet_says(tmp_path: Path) -> None:
    def weigh(name: str) -> list[bool]:
        return ["payload" in {s.kind for s in rig.machine.sensors} for rig in load_scenario(name).rigs()]

    assert weigh("paper_site") == [False] * 3
    assert weigh("haul_road") == [True] * 5
    assert weigh("loading") == [True] * 4
    fleet = '[[fleet]]\nname = "{}"\nroutes = ["{}"]\n{}'
    assert weigh(write(tmp_path, fleet.format("a", "west", "payload = true\n"))) == [True]
    own = fleet.format("a", "haul", "payload = false\n") + fleet.format("b", "haul", "")
    lap = '[[route]]\nname = "lap"\ncorners = [[30, 30], [90, 30], [90, 90], [30, 90]]\n'
    haul = load_toml(FOLDER / "haul_road.toml")["route"][0]["leg"]
    legs = "".join(f"[[route.leg]]\ncorners = {leg['corners']}\npayload_kg = {leg['payload_kg']}\n" for leg in haul)
    text = own + fleet.format("c", "lap", "") + f'[[route]]\nname = "haul"\n{legs}' + lap
    assert weigh(write(tmp_path, text.replace("22000", "2000"), "haul_road")) == [False, True, False]


def test_bad_machine_and_repaved_say_what_is_wrong_and_when() -> None:
    faults = {rig.machine.name: rig.faults for rig in load_scenario("bad_machine").rigs()}
    assert faults["loader-2"].torque_scale == 1.6
    assert np.hypot(*faults["loader-2"].antenna_off_m[:2]) == 3.0
    assert [f.torque_scale for name, f in faults.items() if name != "loader-2"] == [1.0] * 3
    changes = load_scenario("repaved").change
    assert [change.at_s for change in changes] == [150.0, 200.0]


def test_scenario_over_a_base_replaces_key_by_key(tmp_path: Path) -> None:
    mine = load_scenario(write(tmp_path, 'seed = 7\n[[fleet]]\nname = "digger"\nroutes = ["west"]\n'))
    base = load_scenario("paper_site")
    assert (mine.seed, mine.machine_names) == (7, ("digger",))
    assert (mine.ground, mine.route, mine.site) == (base.ground, base.route, base.site)


def test_base_may_be_a_file_beside(tmp_path: Path) -> None:
    (tmp_path / "base.toml").write_text('base = "paper_site"\nseconds = 33.0\n')
    assert load_scenario(write(tmp_path, "seed = 1", "base.toml")).seconds == 33.0


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


def test_site_sensors_and_model_reach_the_rigs(tmp_path: Path) -> None:
    text = '[[fleet]]\nname = "t"\nmodel = "dump_truck"\nroutes = ["west"]\ngps = [3]\nimu = [1, 4]\nattitude = [4]\n'
    (rig,) = load_scenario(write(tmp_path, text)).rigs()
    assert rig.model == load_model("dump_truck")
    assert {s.name for s in rig.machine.sensors} >= {"gps-3", "imu-1", "imu-4", "attitude-4"}
    assert not {s.name for s in rig.machine.sensors} & {"gps-1", "imu-2", "imu-3"}


FLEET = '[[fleet]]\nname = "a"\nroutes = ["{route}"]\n'
CHANGE = '[[change]]\nat_s = {at_s}\nsoil = "{soil}"\noutline = [[0, 0], [9, 0], [9, 9]]'
BAD = {
    "sped = 4": "unknown key `sped`",
    "seed = -1": "seed, seconds: negative",
    'world = "mars"': "world: 'mars' is neither pybullet nor fast",
    "[ground]\nwidth_m = 200.0\ndepth_m = 150.0": r"ground: key `soil` is missing",
    '[ground]\nwidth_m = 200.0\ndepth_m = 150.0\nsoil = "mud"': "soil: 'mud' is none of",
    '[[fleet]]\nname = "a"\nroutes = ["west"]\nspeed = 3': r"fleet\[0\]: unknown key `speed`",
    '[[fleet]]\nname = "a"\nroutes = ["north"]': r"\[\[fleet\]\] \"a\": routes: there is no 'north'; there are west",
    '[[fleet]]\nname = "a"\nroutes = []': "routes: none is named",
    '[[fleet]]\nname = "A b"\nroutes = ["west"]': "name: 'A b' is not a name",
    '[[fleet]]\nname = "a"\nroutes = ["west"]\ncount = 0': "count: 0 is not between 1 and 1000",
    '[[fleet]]\nname = "a"\nroutes = ["west"]\ndrive_mps = nan': "drive_mps",
    '[[fleet]]\nname = "a"\nroutes = ["west"]\nmodel = "tank"': "\"a\": .*there is no 'tank'; known: dump_truck, wheel",
    '[[fleet]]\nname = "a"\nroutes = ["west"]\npreset = "best"': "\"a\": .*'best'.*dgps",
    '[[fleet]]\nname = "a"\nroutes = ["west"]\ngps = [4]': '"a": .*gps.*4',
    '[[fleet]]\nname = "a"\nroutes = ["west"]\nimu = [1, 1]': '"a": .*imu.*1',
    '[[fleet]]\nname = "a"\nroutes = ["west"]\n[[fleet]]\nname = "a"\nroutes = ["east"]': "two machines are named 'a'",
    FLEET.format(route="west") + 'count = 999\n[[fleet]]\nname = "b"\nroutes = ["west"]\ncount = 2': "more than 1000",
    '[[fault]]\nmachine = "loader-9"': "fault: there is no machine 'loader-9'; there are loader-1",
    '[[fault]]\nmachine = "loader-1"\ntorque = 2': r"fault\[0\]: unknown key `torque`",
    CHANGE.format(at_s=0.0, soil="sand"): r"change\[0\]: at_s: 0.0 is not positive",
    CHANGE.format(at_s=5.0, soil="oil"): r"change\[0\]: soil: 'oil'",
    '[[route]]\nname = "r"\n[[route.leg]]\ncorners = [[30, 30], [60, 30]]\n'
    "[[route.leg]]\ncorners = [[60, 30], [30, 30]]\nreverse = true\n"
    '[[fleet]]\nname = "a"\nroutes = ["r"]\nother_way = true': "other_way: route 'r' is no closed tour",
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
    "corners = [[30, 30], [30.5, 30], [60, 60]]": "less than 1 m apart",
    "corners = [[30, 30], [nan, 30], [60, 60]]": "finite number",
    "corners = [[30, 30], [90, 30], [60, 60]]\nrounding_m = 0.0": "rounding_m",
    leg("[[30, 30], [60, 30]]") + leg("[[65, 30], [30, 30]]", "reverse = true"): "leg 1 ends 5.0 m from where the next",
    leg("[[30, 30], [60, 30]]") + leg("[[60, 30], [30, 30]]"): "turn around with a bend of 180 deg",
    leg("[[30, 30], [60, 30]]") + leg("[[60, 30], [60, 60], [30, 30]]", "reverse = true"): "reverse with a bend of 90",
    leg("[[30, 30], [60, 30]]", "payload_kg = 9000.0")
    + leg("[[60, 30], [30, 30]]", "reverse = true"): "payload_kg: 9000 kg is more than a wheel_loader carries, 5000",
    leg("[[30, 30], [60, 30]]", "wait_s = -1.0"): "wait_s: -1.0 is not between",
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
    for name, words in (("nowhere", "'nowhere'; known: bad_machine, base_station"), ("gone.toml", r"gone\.toml")):
        with pytest.raises(ConfigError, match=words):
            load_scenario(name)
