"""Skid-steered machines in the fast world."""

import math
from dataclasses import replace

import numpy as np
import pytest

from protocol.units import GRAVITY_MPS2
from sim.machines.model import load_model
from sim.scenario.file import load_scenario
from sim.sensors.presets import load_preset
from sim.sensors.rigs import machine_config
from sim.terrain.terrain import CONCRETE
from sim.worlds.fast import FastWorld
from tests.unit.sim.planes import LOADER, Lane, cruise, lanes

SKID = load_model("skid_loader")
TURN = 0.3  # virtual joint angle [rad]


def drive_over_weight(steer: float) -> tuple[float, float]:
    """Of a skid loader, and of one with a joint, at 2 m/s."""
    with lanes(FastWorld, [Lane(SKID, CONCRETE), Lane(LOADER, CONCRETE)]) as world:
        late = cruise(world, 2.0, 12.0, steer)[-200:]
    share = np.mean([state.torque_nm / LOADER.wheel_radius_m / state.mass_kg for state in late], axis=0) / GRAVITY_MPS2
    return float(share[0]), float(share[1])


def test_a_turn_costs_a_machine_that_skids_what_its_wheels_slide_against() -> None:
    straight, turning = drive_over_weight(0.0), drive_over_weight(TURN)
    assert straight[0] == pytest.approx(straight[1], abs=1e-4)
    length = SKID.wheelbase_m
    curvature = math.sin(TURN) / (0.5 * length * (1 + math.cos(TURN)))
    slides = min(0.5 * length * curvature / 0.1, 1.0)
    expected = SKID.skid_grip * 0.25 * length * curvature * slides
    assert expected > 0.02
    assert turning[0] - turning[1] == pytest.approx(expected, rel=0.1)


def test_its_agent_knows_that_it_skid_steers_and_that_it_has_no_joint() -> None:
    skid, jointed = (machine_config("m", model, load_preset("dgps"), (1,), (3,), ()) for model in (SKID, LOADER))
    assert skid.skid_steers
    assert jointed.skid_steers is None
    assert [s.kind for s in jointed.sensors if s not in skid.sensors] == ["articulation"]


def test_pybullet_has_no_machines_that_skid_steer() -> None:
    scenario = load_scenario("paper_site")
    skids = replace(scenario, fleet=(replace(scenario.fleet[0], model="skid_loader"),))
    with pytest.raises(ValueError, match="world"):
        skids.rigs()
    assert all(rig.machine.skid_steers for rig in replace(skids, world="fast").rigs())
