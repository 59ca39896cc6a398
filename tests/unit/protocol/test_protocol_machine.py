import dataclasses
import math
import tomllib

import numpy as np
import pytest

from protocol.config import from_table
from protocol.errors import ConfigError
from protocol.machine import MachineConfig, Mount, SensorConfig, machine_toml, parse_machine

GPS = SensorConfig("gps-1", "gps", Mount((1.5, -0.5, 3.25), (0.0, 0.0, 180.0)), drift_share=0.5, use=False)
MACHINE = MachineConfig("loader-1", mass_kg=16_000.0, sensors=(GPS, SensorConfig("imu-1", "imu")))


def test_machine_as_toml_reads_back():
    table = tomllib.loads(machine_toml(MACHINE))
    sensors = tuple(from_table(SensorConfig, t, "sensor") for t in table["sensor"])
    assert parse_machine(table["machine"], sensors, "x.toml") == MACHINE
    assert MACHINE.sensor("gps-1") == GPS
    assert MACHINE.sensor("none") is None


@pytest.mark.parametrize(
    ("rpy_deg", "axis", "expected"),
    [
        ((0, 0, 90), (1, 0, 0), (0, 1, 0)),  # yaw turns ahead to the left
        ((0, 90, 0), (1, 0, 0), (0, 0, -1)),  # pitch turns ahead down
        ((90, 0, 0), (0, 1, 0), (0, 0, 1)),  # roll turns left up
        ((90, 0, -90), (0, 1, 0), (0, 0, 1)),
        ((90, 0, -90), (1, 0, 0), (0, -1, 0)),
    ],
)
def test_mount_turns_axes(rpy_deg, axis, expected):
    assert Mount(rpy_deg=rpy_deg).base_from_sensor() @ axis == pytest.approx(expected, abs=1e-12)


def test_mount_is_a_rotation():
    rotation = Mount(rpy_deg=(10.0, -20.0, 130.0)).base_from_sensor()
    assert rotation @ rotation.T == pytest.approx(np.eye(3), abs=1e-12)
    assert math.isclose(np.linalg.det(rotation), 1.0)


@pytest.mark.parametrize(
    "change",
    [{"name": "A"}, {"mass_kg": 0.0}, {"wheel_radius_m": -1.0}, {"rotating_mass_factor": 0.9}, {"sensors": (GPS, GPS)}],
)
def test_impossible_machine_is_refused(change):
    with pytest.raises(ValueError, match=next(iter(change))):
        dataclasses.replace(MACHINE, **change)


@pytest.mark.parametrize(
    "change",
    [
        {"name": "a b"},
        {"kind": "sonar"},
        {"drift_share": 1.5},
        {"drift_time_s": 0.0},
        {"ticks_per_rev": 0},
        {"frame": "bucket_link"},
        {"gives": ("force",)},
        {"delay_s": -0.1},
        {"delay_s": float("nan")},
        {"gate_sigma": -1.0},
    ],
)
def test_impossible_sensor_is_refused(change):
    with pytest.raises(ValueError, match=next(iter(change))):
        dataclasses.replace(GPS, **change)


def test_a_sensor_may_give_a_part_of_what_its_kind_does():
    imu = SensorConfig("imu", "imu", gives=("rate",))
    assert (imu.says("rate"), imu.says("force")) == (True, False)
    assert SensorConfig("imu", "imu").says("force")
    with pytest.raises(ValueError, match="gives: imu has no 'tilt', but rate, force"):
        SensorConfig("imu", "imu", gives=("tilt",))


def test_every_option_of_a_sensor_is_written_and_read_back():
    imu = SensorConfig("imu", "imu", use=False, gives=("rate",), delay_s=0.2, gate_sigma=5.0, frame="front_link")
    table = tomllib.loads(machine_toml(MachineConfig("a", sensors=(imu,))))
    assert from_table(SensorConfig, table["sensor"][0], "x") == imu


def test_errors_of_a_machine_name_the_file():
    with pytest.raises(ConfigError, match=r"x\.toml \[machine\].*mass"):
        parse_machine({"name": "a", "mass": 1.0}, (), "x.toml")
    with pytest.raises(ConfigError, match=r"x\.toml: sensors: two"):
        parse_machine({"name": "a"}, (GPS, GPS), "x.toml")
