from dataclasses import fields, replace

import numpy as np
import pytest

from sim.machines.model import BASE, FRONT, PAYLOAD, WHEELS, MachineModel
from sim.machines.urdf import Mass, Transform, combined, read_urdf, rigid_urdf
from tests.unit.sim.planes import BOTH, LOADER


@BOTH
def test_lengths_and_masses_are_those_of_the_urdf(model: MachineModel) -> None:
    robot = model.robot
    hubs = np.array([robot.place(wheel, BASE).xyz_m for wheel in WHEELS])
    length, half = model.wheelbase_m, 0.5 * model.track_m
    expected = [[length, half], [length, -half], [0, half], [0, -half]]
    np.testing.assert_allclose(hubs, [[*xy, model.wheel_radius_m] for xy in expected], atol=1e-12)
    np.testing.assert_allclose(robot.place(FRONT, BASE).xyz_m, [model.rear_to_joint_m, 0, model.wheel_radius_m])
    assert model.weight().mass_kg == pytest.approx(model.mass_kg)
    assert robot.links[PAYLOAD].mass.mass_kg == model.payload_kg
    assert {robot.links[wheel].mass.inertia_kgm2[1, 1] for wheel in WHEELS} == {model.wheel_inertia_kgm2}


@pytest.mark.parametrize("name", [f.name for f in fields(MachineModel) if f.type == "float" and f.name != "skid_grip"])
def test_values_that_no_machine_has_are_refused(name: str) -> None:
    with pytest.raises(ValueError, match=name):
        replace(LOADER, **{name: 0.0})


def test_joining_masses_is_steiner_and_does_not_depend_on_the_order() -> None:
    turned = Transform(np.array([2.0, 0, 0]), np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]))
    straight = Transform(np.zeros(3), np.eye(3))
    parts = [
        (straight, Mass(3.0, np.array([0.0, 0, 1]), np.diag([1.0, 2, 3]))),
        (turned, Mass(1.0, np.zeros(3), np.diag([4.0, 5, 6]))),
    ]
    whole = combined(parts)
    np.testing.assert_allclose(whole.centre_m, [0.5, 0, 0.75])
    # reduced mass 0.75 kg at a distance (2, 0, -1)
    expected = np.diag([1.0 + 5, 2 + 4, 3 + 6]) + 0.75 * np.array([[1.0, 0, 2], [0, 5, 0], [2, 0, 4]])
    np.testing.assert_allclose(whole.inertia_kgm2, expected, atol=1e-12)
    other = combined(parts[::-1])
    np.testing.assert_allclose(other.inertia_kgm2, whole.inertia_kgm2, atol=1e-12)


@BOTH
def test_the_few_rigid_bodies_weigh_and_lie_as_the_whole(model: MachineModel, tmp_path) -> None:
    turning = tuple(name for name, joint in model.robot.joints.items() if joint.kind == "revolute")
    path = tmp_path / "rigid.urdf"
    path.write_text(rigid_urdf(model.robot, (BASE, *turning), 1.1), encoding="utf-8")
    rigid = read_urdf(path)
    parts = [(rigid.place(name, BASE), link.mass) for name, link in rigid.links.items()]
    whole, full = combined(parts), model.weight(model.payload_kg)
    assert whole.mass_kg == pytest.approx(1.1 * full.mass_kg)
    np.testing.assert_allclose(whole.centre_m, full.centre_m, atol=1e-9)
    np.testing.assert_allclose(whole.inertia_kgm2, 1.1 * full.inertia_kgm2, rtol=1e-9, atol=1e-6)
    boxes = sum(len(link.boxes) for link in rigid.links.values())
    assert boxes == sum(len(link.boxes) for link in model.robot.links.values()) >= 2
