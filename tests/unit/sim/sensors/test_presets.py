import math
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest

from protocol.errors import ConfigError
from protocol.files import load_toml
from protocol.machine.machine_config import BASE, FRONT
from sim.sensors.presets import LIBRARY, GpsNoise, load_preset, parse_preset
from sim.sensors.rigs import draw_bodies, machine_config
from sim.sensors.sensors import _GROUPS
from tests.unit.sim.sensor_rigs import DGPS, LOADER, noisy, perfect, rig

NAMES = tuple(load_toml(LIBRARY))


@pytest.mark.parametrize("name", NAMES)
def test_every_preset_of_the_library_loads(name: str) -> None:
    preset = load_preset(name)
    assert preset.name == name
    assert all(preset.rate_hz(kind) > 0 for kind in ("gps", *_GROUPS))


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"base": "best"}, ["'best'", "known: dgps, paper, standalone, rtk, harsh"]),
        ({"base": "dgps", "gps": {"drift_m": 1.0}}, ["gps", "`drift_m`", "drift_std_m"]),
        ({"base": "dgps", "gps": {"shared": 0.5}}, ["gps", "`shared`", "machine_share, site_share"]),
        ({"base": "dgps", "gps": {"machine_share": 1.5}}, ["gps", "machine_share: 1.5"]),
        ({"base": "dgps", "gps": {"site_share": 0.5}}, ["gps", "site_share: 0.5 is above machine_share"]),
        ({"base": "dgps", "gps": {"rate_hz": 7}}, ["rate_hz: 7 does not divide 100"]),
        ({"base": "dgps", "name": "Not A Name"}, ["name"]),
        ({}, ["`gps` is missing"]),
    ],
)
def test_broken_presets_are_refused_by_name(table: dict[str, Any], words: list[str]) -> None:
    with pytest.raises(ConfigError) as refusal:
        parse_preset({"name": "mine", **table}, "scenario.toml [[preset]] 1")
    for word in ("scenario.toml [[preset]] 1", *words):
        assert word in str(refusal.value)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("kind", [f.name for f in fields(DGPS) if f.name != "name"])
def test_every_value_has_its_range(kind: str) -> None:
    noise = getattr(DGPS, kind)
    for field in fields(noise):
        if isinstance(getattr(noise, field.name), bool):
            continue
        for bad in (math.nan, -1, 1e9):
            with pytest.raises(ValueError, match=rf"^{field.name}: .*"):
                replace(noise, **{field.name: bad})


def test_outage_cannot_be_longer_than_its_period() -> None:
    with pytest.raises(ValueError, match="outage_s"):
        GpsNoise(5, 1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 11.0, 10.0, 0.1)


# --- machines --------------------------------------------------------------------------------------------------------


def test_machine_has_the_sensors_asked_for_fast_ones_first() -> None:
    machine = machine_config("a", LOADER, DGPS, (1, 2), (3, 1), (3,))
    names = [sensor.name for sensor in machine.sensors]
    assert names == ["imu-3", "imu-1", "attitude-3", "torque", "wheels", "articulation", "gps-1", "gps-2"]
    assert [sensor.frame for sensor in machine.sensors[:3]] == [BASE, FRONT, BASE]
    assert machine.sensors[1].mount == LOADER.imu_mounts()[0][1]
    assert machine.sensors[2].mount == LOADER.imu_mounts()[2][1]
    assert [sensor.mount for sensor in machine.sensors[-2:]] == list(LOADER.gps_mounts()[:2])
    weighed = machine_config("a", LOADER, DGPS, (1,), (3,), (), payload=True)
    assert (weighed.sensors[-1].name, weighed.sensors[-1].kind) == ("payload", "payload")
    bare = machine_config("a", LOADER, noisy("torque", rate_hz=5), (), (), ())
    assert [sensor.name for sensor in bare.sensors] == ["wheels", "articulation", "torque"]


def test_agents_know_the_nominal_body_and_what_a_data_sheet_says() -> None:
    machine = machine_config("a", LOADER, load_preset("paper"), (3,), (), ())
    for name in ("mass_kg", "wheel_radius_m", "load_centre_m", "rotating_mass_factor"):
        assert getattr(machine, name) == getattr(LOADER, name)
    known = (machine.wheelbase_m, machine.axle_stiffness_npm, machine.cog_height_m)
    assert known == pytest.approx((3.3, 1.8e6, 1.05))
    assert (machine.payload_x_m, machine.payload_z_m) == pytest.approx((4.7, 0.85))  # ahead of the front axle
    receiver = machine.sensors[-1]
    assert (receiver.name, receiver.drift_share, receiver.drift_time_s) == ("gps-3", 0.9, 45.0)
    assert machine_config("a", LOADER, DGPS, (1,), (), ()).sensors[-1].drift_share == 0.75
    assert machine_config("a", LOADER, perfect(), (1,), (), ()).sensors[-1].drift_share == 0.0
    fine = machine_config("a", LOADER, noisy("encoder", ticks_per_rev=400), (), (), ())
    assert [s.ticks_per_rev for s in fine.sensors if s.kind == "encoder"] == [400]


def test_bodies_differ_from_nominal_by_what_the_preset_says() -> None:
    n = 400
    bodies = draw_bodies([rig()] * n, 3)
    mass, radius = bodies.mass_kg / LOADER.mass_kg - 1, bodies.wheel_radius_m / LOADER.wheel_radius_m - 1
    assert 0.029 < abs(mass).max() <= 0.03
    assert mass.std() == pytest.approx(0.03 / math.sqrt(3), rel=5 / math.sqrt(2 * n))
    assert radius.std() == pytest.approx(0.015, rel=5 / math.sqrt(2 * n))
    exact = replace(rig(), preset=replace(DGPS, body=replace(DGPS.body, mass=0.0, wheel_radius=0.0)))
    np.testing.assert_array_equal(draw_bodies([exact], 3).mass_kg, [LOADER.mass_kg])
    np.testing.assert_array_equal(draw_bodies([rig(), exact], 3).mass_kg[0], bodies.mass_kg[0])
