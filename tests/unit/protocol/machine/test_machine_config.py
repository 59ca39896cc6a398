import dataclasses
import math
import tomllib

import pytest

from protocol.config import from_table
from protocol.machine.machine_config import QUANTITIES, MachineConfig, Mount, SensorConfig, machine_toml, parse_machine
from protocol.machine.powertrain_config import PowertrainConfig
from protocol.machine.readings import KINDS

GPS = SensorConfig("gps-1", "gps", Mount((1.5, -0.5, 3.25), (0.0, 0.0, 180.0)), drift_share=0.5, use=False)
MACHINE = MachineConfig("loader-1", mass_kg=16_000.0, sensors=(GPS, SensorConfig("imu-1", "imu")))


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
    [
        {"name": "A"},
        {"mass_kg": 0.0},
        {"wheel_radius_m": -1.0},
        {"wheel_radius_m": 750.0},
        {"rotating_mass_factor": 0.9},
        {"sensors": (GPS, GPS)},
    ],
)
def test_impossible_machine_is_refused(change):
    with pytest.raises(ValueError, match=next(iter(change))):
        dataclasses.replace(MACHINE, **change)


@pytest.mark.parametrize("xyz_m", [(800.0, 0.0, 3350.0), (0.0, 0.0, -3350.0), (0.0, float("nan"), 0.0)])
def test_a_lever_arm_off_the_machine_is_refused(xyz_m):
    with pytest.raises(ValueError, match=r"xyz_m: .* is off any machine; if that is mm, write (0.8|-3.35|nan)"):
        Mount(xyz_m)


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


def test_every_option_of_a_machine_is_written_and_read_back():
    body = {
        f.name: 1.25 + i / 16
        for i, f in enumerate(dataclasses.fields(MachineConfig))
        if f.name not in ("name", "sensors", "powertrain")
    }
    body |= {"powertrain": PowertrainConfig(1900.0, 0.1, (9.0, 4.0), (8.0,), 5.1, 0.9, 3e6)}
    machine = MachineConfig("a", **{**body, "mass_kg": 2500.0, "machine_share": 0.5, "skid_steers": True})
    assert parse_machine(tomllib.loads(machine_toml(machine))["machine"], (), "x") == machine


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


def test_steering_in_use_needs_the_wheelbase():
    steering = SensorConfig("wheel-angle", "steering")
    with pytest.raises(ValueError, match="wheelbase_m: wheel-angle: steering is of no use without it"):
        MachineConfig("truck", sensors=(steering,))
    assert MachineConfig("truck", sensors=(dataclasses.replace(steering, use=False),))
    assert MachineConfig("truck", wheelbase_m=2.5, sensors=(steering,))
