"""Drive trains against the agent's own model, and the bytes of their bus."""

from __future__ import annotations

from dataclasses import replace
from math import pi

import numpy as np
import pytest

from agents.drivers.can.pgns import SIGNALS
from agents.drivers.can.signals import frame_of
from agents.estimation.powertrain import engine_drive, retarded
from agents.pipeline import Pipeline
from agents.positioning import PipelineConfig
from protocol.machine.readings import Brake, Driveline, Engine, EngineLosses, FuelRate, HydraulicPressure, Odometry
from protocol.units import DIESEL_J_PER_L, GRAVITY_MPS2
from sim.can.live import address_of
from sim.can.node import IDLE_PA
from sim.config import SimConfig
from sim.machines.drive_train import INDICATED_EFFICIENCY, DriveTrain, Gearbox, Shafts, shafts
from sim.machines.model import load_model
from sim.scenario.file import load_scenario
from sim.simulator import Simulator

TRUCK = load_model("dump_truck")


def train_of(model: str) -> DriveTrain:
    train = load_model(model).drive_train
    assert train
    return train


def steady(train: DriveTrain, radps: float, torque_nm: float, pumps: float = 0.0) -> Shafts:
    """A drive train some seconds after it began to do so."""
    wheels, n = np.full(2000, radps), np.ones(2000)
    return shafts(train, Gearbox(train).run(wheels), wheels, torque_nm * n, pumps * n)


@pytest.mark.parametrize("model", ["dump_truck", "wheel_loader"])
@pytest.mark.parametrize("speed_mps", [2.5, 4.0, 8.0, -1.6])
@pytest.mark.parametrize("force_n", [3e3, 30e3])
def test_an_agent_computes_the_force_at_the_wheels_back(model: str, speed_mps: float, force_n: float) -> None:
    train, radius_m = train_of(model), load_model(model).wheel_radius_m
    force_n = np.copysign(force_n, speed_mps)
    known = steady(train, speed_mps / radius_m, force_n * radius_m)
    assert known.locked[-1]
    assert not known.shifting[-1]
    share = float(known.torque[-1] - known.losses[-1])
    drive = engine_drive(train.data_sheet, share, float(known.engine_radps[-1]), speed_mps, radius_m)
    assert not drive.unknown
    assert drive.force_n == pytest.approx(force_n, rel=1e-9)


def test_an_engine_brakes_by_its_losses_first_then_the_retarder_whose_force_an_agent_computes_then_the_brakes() -> None:
    train, radps = train_of("dump_truck"), 8.0 / 0.9
    gentle, firm, hard = (steady(train, radps, -nm) for nm in (2e3, 30e3, 150e3))
    assert [known.retarder[-1] for known in (gentle, hard)] == [0.0, 1.0]
    assert 0 < firm.retarder[-1] < 1
    assert [bool(known.braked[-1]) for known in (gentle, firm, hard)] == [False, False, True]
    assert gentle.torque[-1] > firm.torque[-1] == 0.0 == firm.litres_ph[-1]
    drag = engine_drive(train.data_sheet, -float(firm.losses[-1]), float(firm.engine_radps[-1]), 8.0, 0.9)
    assert retarded(train.data_sheet, drag, float(firm.retarder[-1]), 8.0, 0.9).force_n == pytest.approx(-30e3 / 0.9)


def test_gears_rise_with_speed_and_a_machine_that_stands_idles_with_an_open_converter() -> None:
    train = train_of("dump_truck")
    gears = [int(steady(train, speed / 0.9, 1e4).gear[-1]) for speed in (0.5, 2.0, 4.0, 8.0, 12.0, -1.5)]
    assert gears == [*sorted(gears[:-1]), -1]
    assert len(set(gears)) > 3
    stands = steady(train, 0.0, 0.0)
    assert not stands.locked[-1]
    assert stands.engine_radps[-1] == pytest.approx(train.idle_rpm * pi / 30)
    burned_w = stands.litres_ph[-1] / 3600 * DIESEL_J_PER_L * INDICATED_EFFICIENCY
    lost = stands.losses[-1] * train.data_sheet.reference_torque_nm * stands.engine_radps[-1]
    assert burned_w == pytest.approx(lost)


def test_pumps_load_the_engine_and_not_the_wheels() -> None:
    train = train_of("wheel_loader")
    idle, busy = (steady(train, 3.0, 5e3, share) for share in (0.0, 0.2))
    assert busy.torque - idle.torque == pytest.approx(0.2)
    assert (busy.litres_ph > idle.litres_ph).all()


@pytest.mark.parametrize("signal", SIGNALS.values(), ids=lambda signal: signal.name)
def test_what_is_put_into_a_frame_is_read_from_it_to_half_a_step_and_the_rest_is_not_available(signal) -> None:
    draw = np.random.default_rng(7)
    low = signal.offset if not signal.is_signed else -abs(signal.scale) * (1 << signal.bits - 1)
    span = abs(signal.scale) * signal._highest * (2 if signal.is_signed else 1)
    for value in (low + span * draw.random(50)).tolist():
        frame = frame_of([(signal, value)])
        assert signal.value(frame) == pytest.approx(value, abs=abs(signal.scale) * 0.5001)
        others = (one for one in SIGNALS.values() if one.group == signal.group and one is not signal)
        assert all(one.value(frame) is None for one in others if not one.is_signed)
    assert signal.value(frame_of([(signal, 1e12)])) is not None, "the highest value, and no error"


@pytest.mark.slow
def test_an_agent_reads_of_the_bus_what_the_machine_does() -> None:
    """Speed, gearing and fuel within their steps; nothing of the truth reaches it by another way."""
    scenario = load_scenario("loading")
    fleet = (replace(scenario.fleet[0], can=True, count=1),)
    simulator = Simulator(SimConfig(), replace(scenario, fleet=fleet, world="fast", seconds=30.0, fault=()))
    (machine,) = simulator.machines
    kinds = {sensor.kind for sensor in machine.sensors}
    assert not kinds & {"torque", "encoder"}
    assert machine.powertrain == train_of("wheel_loader").data_sheet
    readings, pulls, pipeline = [], [], Pipeline(simulator.site, machine, PipelineConfig())
    for _ in range(600):
        readings += (heard := simulator.advance()[machine.name])
        pipeline.step(heard)
        true = float(simulator.state.drive_n[0] / simulator.state.mass_kg[0] / GRAVITY_MPS2)
        pulls.append((true, pipeline.positioning.dead_reckoning.traction))
    by_truth, by_agent = np.array(pulls[100:]).T
    assert by_truth.max() > 0.05
    assert np.median(np.abs(by_agent - by_truth)) < 0.015, "wheels slip by it"
    assert [one.stamp_ns for one in readings] == sorted(one.stamp_ns for one in readings)
    by_kind = {kind: [one for one in readings if isinstance(one, kind)] for kind in (Engine, FuelRate, Odometry)}
    rates = {kind.kind: len(own) / 30 for kind, own in by_kind.items()}
    assert rates == pytest.approx({"engine": 50, "fuel_rate": 10, "odometry": 50}, rel=0.02)
    speeds = np.array([one.speed_x_mps for one in by_kind[Odometry]])[1::5][:590]
    assert np.abs(speeds).max() > 1.5
    torque = np.array([one.torque for one in by_kind[Engine]])
    assert (100 * torque).round(6) == pytest.approx((100 * torque).round())
    assert {type(one) for one in readings} >= {Brake, Driveline, EngineLosses, HydraulicPressure}
    assert min(one.pressure_pa for one in readings if isinstance(one, HydraulicPressure)) == IDLE_PA


def test_buses_of_a_fleet_count_on_from_the_first() -> None:
    assert [address_of("can0", i) for i in (0, 3)] == ["can0", "can3"]
    assert address_of("udp_multicast://239.74.163.2:43113", 1) == "udp_multicast://239.74.163.2:43114"
    assert address_of("virtual://site", 2) == "virtual://site2"


def test_a_machine_without_a_drive_train_cannot_speak() -> None:
    scenario = load_scenario("loading")
    fleet = (replace(scenario.fleet[0], can=True, model="skid_loader"),)
    with pytest.raises(ValueError, match="skid_loader has no drive train"):
        replace(scenario, fleet=fleet, world="fast").rigs()
