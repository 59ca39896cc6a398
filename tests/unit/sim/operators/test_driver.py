import math
from dataclasses import fields
from functools import cache

import numpy as np
import pytest

from protocol.units import GRAVITY_MPS2
from sim.config import SimConfig
from sim.operators.driver import bend
from sim.state import FleetState
from tests.unit.sim.drives import Driven, drive


@cache
def paper(world: str) -> Driven:
    """The paper's three tours for 125 s: a whole lap."""
    return drive(SimConfig(seed=5, world=world), 125.0)


@pytest.fixture(scope="module")
def quarry() -> Driven:
    """Trucks and a loader at work for five minutes."""
    return drive(SimConfig(scenario="haul_road", world="fast", seed=1), 300.0)


@pytest.mark.parametrize("steer", [0.1, -0.4, 0.6])
@pytest.mark.parametrize(("rear", "front"), [(1.65, 1.65), (3.0, 1.2)])
def test_bend_is_the_articulation_of_the_joints_circle(steer: float, rear: float, front: float) -> None:
    rear_radius = (front + rear * math.cos(steer)) / math.sin(steer)  # no axle slides sideways
    joint_radius = math.copysign(math.hypot(rear_radius, rear), rear_radius)
    assert bend(np.array(rear), np.array(front), np.array(1 / joint_radius)) == pytest.approx(steer, abs=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("world", [pytest.param("pybullet", marks=pytest.mark.nightly), "fast"])
def test_nobody_gets_stuck_or_lost(world: str) -> None:
    driven = paper(world)
    states = driven.states
    assert all(np.isfinite(getattr(states, f.name)).all() for f in fields(FleetState))
    assert states.speed_mps.max() < 5.5
    lengths = [route.length_m for route, _, _ in driven.scenario.journeys()]
    assert (states.speed_mps.sum(axis=0) * 0.1 > lengths).all()
    assert driven.off_m[4:].max() < 0.6
    assert abs(states.articulation_rad).max() <= 0.6
    assert abs(states.rates_radps).max() < 0.6
    assert abs(states.force_mps2[10:, :, 2] - GRAVITY_MPS2).max() < 6.0


@pytest.mark.slow
def test_drivers_keep_their_speed_and_slow_down_in_curves() -> None:
    states = paper("fast").states
    straight = abs(states.articulation_rad[300:]) < 0.02
    assert np.median(states.speed_mps[300:][straight]) == pytest.approx(4.0, abs=0.15)
    tight = abs(states.articulation_rad) > 0.3
    assert tight.any()
    assert states.speed_mps[tight].max() < 4.0
    sideways = abs(states.speed_mps * states.rates_radps[..., 2])
    assert np.quantile(sideways, 0.999) < 1.3


@pytest.mark.slow
def test_work_cycles_load_reverse_dump_and_wait_on_their_routes(quarry: Driven) -> None:
    assert quarry.off_m[4:].max() < 0.6
    speed, payload = quarry.states.speed_mps, quarry.payload_kg
    loader, truck = 4, 0
    assert speed[:, loader].min() < -1.0 < 2.0 < speed[:, loader].max()
    assert speed[:, truck].min() > -0.2
    for machine, most in ((loader, 4500.0), (truck, 22000.0)):
        assert payload[:, machine].max() == pytest.approx(most)
        assert payload[:, machine].min() == pytest.approx(0.0)
        changing = np.abs(np.diff(payload[:, machine])) > 1e-6
        slowest = np.minimum(abs(speed[:-1, machine]), abs(speed[1:, machine]))
        assert slowest[changing].max() < 0.05  # loaded at standstill only
        mass = quarry.states.mass_kg[:, machine] - payload[:, machine]
        assert np.ptp(mass) < 1.0
    still = (abs(speed[:, loader]) < 0.02).sum() * 0.1
    cycles = (np.diff((payload[:, loader] > 2000).astype(int)) == 1).sum()
    assert cycles >= 2
    assert still > (cycles - 1) * 10.0  # 6 s at the pile and 4 s at the hopper


@pytest.mark.slow
@pytest.mark.parametrize("machines", [5, pytest.param(9, marks=pytest.mark.nightly)])
def test_machines_give_way(machines: int) -> None:
    driven = drive(SimConfig(world="fast", machines=machines, seed=2), 200.0)
    assert driven.nearest_m > 5.0  # frames touch at half of it
    assert (abs(driven.states.speed_mps).sum(axis=0) * 0.1 > 550).all()


@pytest.mark.slow
def test_without_give_way_machines_drive_on() -> None:
    driven = drive(SimConfig(scenario="busy_site", seed=2), 20.0)
    assert len(driven.scenario.machine_names) == 100
    assert driven.states.speed_mps[100:].min() > 1.0


@pytest.mark.nightly
@pytest.mark.slow
def test_machines_do_not_touch_in_pybullet() -> None:
    """Contact shows as a jolt: nothing else shakes a frame so hard."""
    driven = drive(SimConfig(machines=6, seed=3), 80.0)
    level = driven.states.force_mps2[20:, :, :2]
    assert abs(level).max() < 6.0
    assert (abs(driven.states.speed_mps).sum(axis=0) * 0.1 > 190).all()
