"""Other resistances: brakes with and without sensors, air, drive friction."""

import math
from collections.abc import Sequence
from dataclasses import replace

import pytest

from agents.estimation.balance import AIR_KGPM3
from protocol.machine.machine_config import MachineConfig, SensorConfig
from protocol.machine.readings import Brake, BrakeForce, Reading, Torque
from protocol.units import GRAVITY_MPS2
from tests.unit.agents.drives import Ground, Leg, drive, machine
from tests.unit.agents.ground import EstimatorRun

DOWN_RAD, C_RR = math.radians(-9), 0.03
DOWNHILL = [Leg(2), Leg(4, 0.5), Leg(12)]
BRAKES = SensorConfig("brake", "brake"), SensorConfig("retarder", "brake_force")


def braked(readings: Sequence[Reading], vehicle: MachineConfig, sensors: Sequence[SensorConfig]) -> list[Reading]:
    """The drive with torque that never brakes: brakes do, read by some of the sensors."""
    out: list[Reading] = []
    for reading in readings:
        if not isinstance(reading, Torque):
            out.append(reading)
            continue
        force_n = max(-reading.torque_nm, 0.0) / vehicle.wheel_radius_m
        out.append(replace(reading, torque_nm=max(reading.torque_nm, 0.0)))
        for sensor in sensors:
            is_force = sensor.kind == BrakeForce.kind
            cls, value = (BrakeForce, force_n) if is_force else (Brake, float(force_n > 0))
            out.append(cls(sensor.name, reading.stamp_ns, value))
    return out


@pytest.mark.parametrize(
    ("sensors", "reason"),
    [((), "braking_unseen"), (BRAKES[:1], "braking"), (BRAKES[1:], "")],
    ids=["nothing", "switch", "force"],
)
def test_a_descent_by_brakes_never_passes_for_rough_ground(sensors: Sequence[SensorConfig], reason: str) -> None:
    vehicle = machine()
    vehicle = replace(vehicle, sensors=(*vehicle.sensors, *sensors))
    made = drive(DOWNHILL, vehicle, ground=Ground(C_RR, DOWN_RAD)).readings
    estimates = EstimatorRun(vehicle).feed(braked(made, vehicle, sensors)).between(10, 17)
    assert {e.reason for e in estimates} == {reason}
    for e in estimates:
        assert e.slope_x == pytest.approx(math.tan(DOWN_RAD), abs=0.01)
        assert math.isnan(e.c_rr) if reason else e.c_rr == pytest.approx(C_RR, abs=0.005)


def test_a_torque_that_brakes_is_believed_when_it_is_zero() -> None:
    vehicle = machine()
    descent = drive(DOWNHILL, vehicle, ground=Ground(C_RR, DOWN_RAD)).readings
    assert {e.reason for e in EstimatorRun(vehicle).feed(descent).between(10, 17)} == {""}


@pytest.mark.parametrize("body", [{"drag_area_m2": 6.3}, {"drive_friction_n": 3000.0}], ids=str)
def test_drag_and_friction_of_the_drive_are_no_resistance_of_the_ground(body: dict[str, float]) -> None:
    vehicle = machine()
    made = drive([Leg(2), Leg(10, 1.2), Leg(8)], vehicle, ground=Ground(C_RR)).readings
    plain, stated = (EstimatorRun(v).feed(made).last for v in (vehicle, replace(vehicle, **body)))
    speed_mps = 12.0
    held_n = body.get("drive_friction_n") or AIR_KGPM3 * body["drag_area_m2"] * speed_mps**2 / 2
    assert plain.c_rr - stated.c_rr == pytest.approx(held_n / (vehicle.mass_kg * GRAVITY_MPS2), rel=0.05)


def test_a_brake_sensor_that_falls_silent_holds_the_machine_back_no_longer() -> None:
    vehicle = machine()
    vehicle = replace(vehicle, sensors=(*vehicle.sensors, BRAKES[1]))
    made = drive([Leg(2), Leg(4, 0.5), Leg(12)], vehicle, ground=Ground(C_RR)).readings
    seen = BrakeForce("retarder", made[len(made) // 2].stamp_ns, 3_000.0)
    readings = sorted([*made, seen], key=lambda reading: reading.stamp_ns)
    assert EstimatorRun(vehicle).feed(readings).last.c_rr == pytest.approx(C_RR, abs=0.005)
