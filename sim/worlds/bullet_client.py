"""All calls of PyBullet's physics: machine frames under given forces, without ground.

The line that its import prints to standard error is suppressed.
"""

from __future__ import annotations

import contextlib
import os
import tempfile
import weakref
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from protocol.arrays import Floats
from protocol.machine.machine_config import BASE, FRONT
from protocol.units import GRAVITY_MPS2
from sim.machines.model import PAYLOAD, WHEELS, MachineModel
from sim.machines.urdf import rigid_urdf

OSCILLATION_NM = 2000.0  # of the joint that lets all wheels touch the ground
FRAMES = 3  # rear frame, front frame, carrier of the rear wheels


@dataclass(frozen=True, slots=True)
class Frames:
    """Machine frames in `map`, arrays (n, FRAMES, ...): centre of mass, rotation, velocity, angular rate."""

    centre_m: Floats
    rotation: Floats
    velocity_mps: Floats
    rate_radps: Floats


@dataclass(frozen=True)
class _Machine:
    """PyBullet's indices of one machine; -1 is the rear frame."""

    body: int
    front: int
    rear: int
    payload: int
    articulation: int
    payload_inertia_m2: tuple[float, ...]

    @cached_property
    def links(self) -> list[int]:
        """Links besides the rear frame."""
        return [self.front] if self.rear < 0 else [self.front, self.rear]


class MultiBodies:
    """n machines in one PyBullet client, freed by close() or the garbage collector."""

    def __init__(self, models: Sequence[MachineModel], mass_factor: Floats, base_pose: Floats, dt: float) -> None:
        """base_pose: (n, 7), position and quaternion (x, y, z, w) of each `base_link`."""
        self._client = pybullet.connect(pybullet.DIRECT)
        self.close = weakref.finalize(self, pybullet.disconnect, self._client)
        pybullet.setGravity(0, 0, -GRAVITY_MPS2, physicsClientId=self._client)
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=dt, numSolverIterations=20, deterministicOverlappingPairs=1, physicsClientId=self._client
        )
        rows = zip(models, mass_factor.tolist(), base_pose.tolist(), strict=True)
        self._machines = [self._load(model, factor, pose) for model, factor, pose in rows]
        self._steer_nm = [model.steer_nm for model in models]
        machines, client = self._machines, self._client
        links = [[pybullet.getDynamicsInfo(m.body, link, client) for link in (-1, m.front, m.rear)] for m in machines]
        inertial = np.array([[[*info[3], *info[4]] for info in own] for own in links])
        self.centres_m = inertial[:, :, :3]  # centres of mass in the links' axes: (n, FRAMES, 3)
        self._link_from_inertial = np.swapaxes(rotations(inertial[:, :, 3:]), -1, -2)

    def read(self) -> Frames:
        """Read pose and motion of all frames."""
        client, flat = self._client, list[float]()
        for machine in self._machines:
            body = machine.body
            base = pybullet.getBasePositionAndOrientation(body, client) + pybullet.getBaseVelocity(body, client)
            links = pybullet.getLinkStates(body, machine.links, 1, 1, client)
            for part in base:
                flat += part
            for link in links:
                flat += link[0]  # centre of mass: PyBullet's link frames are single precision
                flat += link[1]
                flat += link[6]
                flat += link[7]
            if machine.rear < 0:
                for part in base:
                    flat += part
        table = np.array(flat).reshape(-1, FRAMES, 13)
        rotation = rotations(table[:, :, 3:7]) @ self._link_from_inertial
        return Frames(table[:, :, :3], rotation, table[:, :, 7:10], table[:, :, 10:])

    def step(self, forces_n: Floats, points_m: Floats, steering_radps: Floats) -> None:
        """Advance by dt. Per wheel a force (n, 4, 3) at a point in `map`; articulation rates (n,)."""
        client, apply, map_frame = self._client, pybullet.applyExternalForce, pybullet.WORLD_FRAME
        rows = zip(
            self._machines, self._steer_nm, forces_n.tolist(), points_m.tolist(), steering_radps.tolist(), strict=True
        )
        for machine, torque, force, point, rate in rows:
            body = machine.body
            apply(body, machine.front, force[0], point[0], map_frame, client)
            apply(body, machine.front, force[1], point[1], map_frame, client)
            apply(body, machine.rear, force[2], point[2], map_frame, client)
            apply(body, machine.rear, force[3], point[3], map_frame, client)
            _turn_joint(client, body, machine.articulation, rate, torque)
        pybullet.stepSimulation(client)

    def set_payload(self, machine: int, payload_kg: float) -> None:
        """Change one machine's payload."""
        m = self._machines[machine]
        inertia = [payload_kg * i for i in m.payload_inertia_m2]
        pybullet.changeDynamics(
            m.body, m.payload, mass=payload_kg, localInertiaDiagonal=inertia, physicsClientId=self._client
        )

    def _load(self, model: MachineModel, mass_factor: float, pose: list[float]) -> _Machine:
        rear = model.robot.joints[WHEELS[2]].parent
        bodies = tuple(name for name, joint in model.robot.joints.items() if joint.kind == "revolute")
        text = rigid_urdf(model.robot, (BASE, *bodies, PAYLOAD), mass_factor)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, model.urdf)
            path.write_text(text, encoding="utf-8")
            body = pybullet.loadURDF(
                str(path), pose[:3], pose[3:], flags=pybullet.URDF_USE_INERTIA_FROM_FILE, physicsClientId=self._client
            )
        joints = [
            pybullet.getJointInfo(body, i, self._client) for i in range(pybullet.getNumJoints(body, self._client))
        ]
        links = {info[12].decode(): info[0] for info in joints} | {BASE: -1}
        names = {info[1].decode(): info[0] for info in joints}
        self._remove_damping(body, names)
        load = model.robot.links[PAYLOAD].mass
        inertia = tuple((np.diag(load.inertia_kgm2) / load.mass_kg).tolist())
        return _Machine(body, links[FRONT], links[rear], links[PAYLOAD], names["articulation"], inertia)

    def _remove_damping(self, body: int, joints: dict[str, int]) -> None:
        """Remove PyBullet's default damping and friction."""
        for link in (-1, *joints.values()):
            pybullet.changeDynamics(
                body, link, linearDamping=0, angularDamping=0, jointDamping=0, physicsClientId=self._client
            )
        _turn_joint(self._client, body, joints["oscillation"], 0.0, OSCILLATION_NM)


def _turn_joint(client: int, body: int, joint: int, radps: float, most_nm: float) -> None:
    velocity = pybullet.VELOCITY_CONTROL
    pybullet.setJointMotorControl2(body, joint, velocity, targetVelocity=radps, force=most_nm, physicsClientId=client)


def _rotation(squares: Floats) -> Floats:
    """Matrix (9,) of a quaternion x, y, z, w, linear in its products (4, 4)."""
    vector, (x, y, z, w) = squares[:3, :3], squares[3]
    turn = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    matrix: Floats = (w - np.trace(vector)) * np.eye(3) + 2 * vector + 2 * turn
    return matrix.ravel()


_ROTATIONS = np.array([_rotation(unit) for unit in np.eye(16).reshape(16, 4, 4)])


def rotations(quaternions: Floats) -> Floats:
    """Matrices (..., 3, 3) of unit quaternions (..., 4) x, y, z, w, as one matrix product for speed."""
    squares = quaternions[..., :, None] * quaternions[..., None, :]
    flat: Floats = squares.reshape(-1, 16) @ _ROTATIONS
    return flat.reshape(*quaternions.shape[:-1], 3, 3)


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Discard standard error, native code's too."""
    try:
        saved = os.dup(2)
    except OSError:  # standard error is closed
        yield
        return
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)
        os.close(nowhere)


with _quiet():
    import pybullet

__all__ = ["pybullet"]
