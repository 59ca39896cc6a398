import dataclasses
import math
import tomllib

import pytest

from protocol.config import from_table
from protocol.errors import ConfigError
from protocol.machine.machine_config import QUANTITIES, MachineConfig, Mount, SensorConfig, machine_toml, parse_machine
from protocol.machine.readings import KINDS

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
    assert Mount(rpy_deg=rpy_deg).frame_from_sensor() @ axis == pytest.approx(expected, abs=1e-12)


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
        {"measures": ("force",)},
        {"std": {"force": 1.0}},
        {"mode": "total"},
        {"delay_s": -10.1},
        {"delay_s": 0.41},
        {"delay_s": float("nan")},
        {"gate_sigma": -1.0},
    ],
)
def test_impossible_sensor_is_refused(change):
    with pytest.raises(ValueError, match=next(iter(change))):
        dataclasses.replace(GPS, **change)


def test_a_sensor_may_measure_a_part_of_what_its_kind_does():
    imu = SensorConfig("imu", "imu", measures=("rate",))
    assert (imu.provides("rate"), imu.provides("force")) == (True, False)
    assert SensorConfig("imu", "imu").provides("force")
    with pytest.raises(ValueError, match="measures: imu: imu has no 'tilt', but rate, force"):
        SensorConfig("imu", "imu", measures=("tilt",))


def test_every_option_of_a_machine_is_written_and_read_back():
    body = {
        f.name: 1.25 + i for i, f in enumerate(dataclasses.fields(MachineConfig)) if f.name not in ("name", "sensors")
    }
    machine = MachineConfig("a", **{**body, "machine_share": 0.5})
    assert parse_machine(tomllib.loads(machine_toml(machine))["machine"], (), "x") == machine


def test_a_machine_share_is_a_share_or_not_stated():
    for share in (None, 0.0, 1.0):
        machine = dataclasses.replace(MACHINE, machine_share=share)
        table = tomllib.loads(machine_toml(machine))["machine"]
        assert ("machine_share" in table) == (share is not None)
        assert parse_machine(table, MACHINE.sensors, "x") == machine
    for bad in (-0.1, 1.01, math.nan):
        with pytest.raises(ValueError, match="machine_share"):
            dataclasses.replace(MACHINE, machine_share=bad)


@pytest.mark.parametrize("name", ["wheelbase_m", "axle_stiffness_npm", "cog_height_m", "payload_z_m"])
def test_what_a_maker_may_not_state_is_0_or_positive(name):
    assert getattr(MACHINE, name) == 0.0
    for bad in (-0.1, math.nan, math.inf):
        with pytest.raises(ValueError, match=name):
            dataclasses.replace(MACHINE, **{name: bad})


def test_every_option_of_a_sensor_is_written_and_read_back():
    std = {"rate": 1e-5, "force": 1.5}
    imu = SensorConfig(
        "imu", "imu", use=False, measures=("rate",), delay_s=0.2, gate_sigma=5.0, frame="front_link", std=std
    )
    gps = dataclasses.replace(GPS, mode="relative")
    table = tomllib.loads(machine_toml(MachineConfig("a", sensors=(imu, gps))))
    assert tuple(from_table(SensorConfig, t, "x") for t in table["sensor"]) == (imu, gps)
    assert len({imu, gps, dataclasses.replace(imu)}) == 2


@pytest.mark.parametrize("kind", KINDS)
def test_a_standard_deviation_goes_by_a_quantity_of_the_kind(kind):
    for name in QUANTITIES.get(kind, ()):
        assert SensorConfig("a", kind, std={name: 0.5}).std[name] == 0.5
        for bad in (0.0, -1.0, math.nan, math.inf):
            with pytest.raises(ValueError, match=f"std: a: {name} must be positive and finite"):
                SensorConfig("a", kind, std={name: bad})
    with pytest.raises(ValueError, match=f"std: a: {kind} has no 'ticks', but "):
        SensorConfig("a", kind, std={"ticks": 1.0})


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("mode", ["relative"])
def test_only_gps_and_attitude_have_another_mode(kind, mode):
    assert SensorConfig("a", kind).mode == "absolute"
    if kind in ("gps", "attitude"):
        assert SensorConfig("a", kind, mode=mode).mode == mode
        return
    with pytest.raises(ValueError, match=f"mode: a: {kind} has no '{mode}', but absolute$"):
        SensorConfig("a", kind, mode=mode)


def test_steering_in_use_needs_the_wheelbase():
    steering = SensorConfig("wheel-angle", "steering")
    with pytest.raises(ValueError, match="wheelbase_m: wheel-angle: steering is of no use without it"):
        MachineConfig("truck", sensors=(steering,))
    assert MachineConfig("truck", sensors=(dataclasses.replace(steering, use=False),))
    assert MachineConfig("truck", wheelbase_m=2.5, sensors=(steering,))


def test_errors_of_a_machine_name_the_file():
    with pytest.raises(ConfigError, match=r"x\.toml \[machine\].*mass"):
        parse_machine({"name": "a", "mass": 1.0}, (), "x.toml")
    with pytest.raises(ConfigError, match=r"x\.toml: sensors: two"):
        parse_machine({"name": "a"}, (GPS, GPS), "x.toml")
