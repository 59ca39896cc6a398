"""The PyBullet world: frames of articulated machines as rigid bodies, tyres and soil as forces from outside."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from protocol.arrays import Floats
from protocol.rotations import quaternion_from_rpy
from protocol.units import GRAVITY_MPS2
from sim.machines.chassis import SETTLE_STEPS, TRACTION_USE, Bodies, chassis_of, drive_force_n, steering_radps
from sim.machines.model import WHEELS, MachineModel
from sim.state import STEP_S, FleetState
from sim.terrain.soil import TRACTION
from sim.terrain.terrain import Terrain
from sim.worlds.bullet_client import MultiBodies
from sim.worlds.bullet_scene import POINT_FRAME, DriveTrain, Weights, WheelGround, scene_at, state_from_scenes
from sim.worlds.tyre import TyreForces, Tyres, WheelMotion, at_rest, radial_load, turn_wheels


@dataclass(frozen=True, slots=True)
class Actuators:
    """Actuators of n machines, all (n,): rate of articulation, drive force, and most force of the brakes."""

    steering_radps: Floats
    drive_n: Floats
    brake_n: Floats


class BulletWorld:
    """n machines on one terrain, moved by PyBullet at 100 Hz.

    starts: x, y [m] and yaw [rad] of each `base_link`, (n, 3), where the machines settle on their tyres.
    """

    def __init__(self, terrain: Terrain, models: Sequence[MachineModel], bodies: Bodies, starts: Floats) -> None:
        self._terrain, self._bodies, self._chassis = terrain, bodies, chassis_of(models)
        mass_factor = bodies.mass_kg / np.array([m.mass_kg for m in models])
        self._multi = MultiBodies(models, mass_factor, _standing(terrain, models, starts), STEP_S)
        self._weights = Weights(bodies.mass_kg, np.zeros(len(models)))
        for machine in range(len(models)):
            self.set_payload(machine, 0.0)

        chassis = self._chassis
        of_wheels = [bodies.wheel_radius_m, chassis.tyre_stiffness_npm, chassis.tyre_damping_nspm]
        of_wheels += [chassis.relaxation_m, chassis.wheel_inertia_kgm2]
        self._tyres = Tyres(*(np.repeat(values[:, None], 4, axis=1) for values in of_wheels))
        # Unloaded tyres are so large that the nominal machine stands level when empty, hubs at their radius.
        sunk_m = 0.5 * np.array([m.mass_kg for m in models]) * GRAVITY_MPS2 / chassis.tyre_stiffness_npm
        share = np.stack([chassis.front_share] * 2 + [1 - chassis.front_share] * 2, axis=-1)
        self._free_radius_m = bodies.wheel_radius_m[:, None] + share * sunk_m[:, None]
        self._arms_m = _points(models) - self._multi.centres_m[:, POINT_FRAME]
        self._rolling = at_rest((len(models), 4))
        self._scene = scene_at(terrain, self._multi.read(), self._arms_m)
        self._wheel_load_n = self._loads(self._scene.ground)

        zero, hold = np.zeros(len(models)), np.array([m.max_brake_n for m in models])
        wheels = np.zeros((len(models), 2))
        self._actuators = Actuators(zero, zero, zero)
        self.state = state_from_scenes(
            self._scene, self._scene, self._wheel_load_n, self._weights, DriveTrain(zero, zero, wheels, wheels)
        )
        for _ in range(SETTLE_STEPS):
            self.advance(zero, zero, hold)
        self.state = replace(self.state, wheel_rad=wheels)

    def set_payload(self, machine: int, payload_kg: float) -> None:
        """Change what one machine carries."""
        self._multi.set_payload(machine, payload_kg)
        carried = self._weights.payload_kg.copy()  # past states keep theirs
        carried[machine] = payload_kg
        self._weights = Weights(self._bodies.mass_kg + carried, carried)

    def set_terrain(self, terrain: Terrain) -> None:
        """Change the ground under the machines."""
        self._terrain = terrain

    def close(self) -> None:
        """Free PyBullet's client."""
        self._multi.close()

    def advance(self, steer_rad: Floats, drive_n: Floats, brake_n: Floats) -> FleetState:
        """Advance by STEP_S; all (n,): articulation to aim at, drive force (signed), most force of the brakes."""
        self._actuators = self._follow_commands(steer_rad, drive_n, brake_n)

        # What the ground does to the wheels where they are now.
        ground, load = self._scene.ground, self._wheel_load_n
        forces = self._roll(ground, load)
        along_wheel = np.stack([forces.traction_n + forces.resistance_n, forces.left_n, load], axis=-1)
        in_map = (along_wheel[..., None, :] @ ground.wheel_from_map)[..., 0, :]

        # Where that takes the machines.
        before = self._scene
        self._multi.step(in_map, ground.point_m, self._actuators.steering_radps)
        self._scene = scene_at(self._terrain, self._multi.read(), self._arms_m, ground.point_m)
        self._wheel_load_n = self._loads(self._scene.ground)
        rear = self._rolling.spin_radps[:, 2:]
        turned = self.state.wheel_rad + STEP_S * rear
        drive = DriveTrain(self._actuators.drive_n, forces.torque_nm.sum(axis=-1), rear, turned)
        self.state = state_from_scenes(before, self._scene, self._wheel_load_n, self._weights, drive)
        return self.state

    def _follow_commands(self, steer_rad: Floats, drive_n: Floats, brake_n: Floats) -> Actuators:
        """Hydraulics and engine follow with their lags."""
        old = self._actuators
        steering = steering_radps(self._chassis, steer_rad, self.state.articulation_rad, old.steering_radps)
        least = TRACTION[self._scene.ground.zone].min(axis=-1)
        grip = TRACTION_USE * least * self.state.load_n
        return Actuators(steering, drive_force_n(self._chassis, drive_n, old.drive_n, grip), brake_n)

    def _loads(self, ground: WheelGround) -> Floats:
        return radial_load(self._tyres, self._free_radius_m - ground.gap_m, -ground.velocity_mps[..., 2])

    def _roll(self, ground: WheelGround, load: Floats) -> TyreForces:
        """Turn the wheels; drive and brakes are split in proportion to the wheels' loads."""
        motion = WheelMotion(load, ground.velocity_mps[..., 0], ground.velocity_mps[..., 1], ground.zone)
        lever = load * (self._tyres.radius_m / np.maximum(load.sum(axis=-1, keepdims=True), 1.0))
        drive, brake = lever * self._actuators.drive_n[:, None], lever * self._actuators.brake_n[:, None]
        self._rolling, forces = turn_wheels(self._tyres, self._rolling, motion, drive, brake, STEP_S)
        return forces


def _standing(terrain: Terrain, models: Sequence[MachineModel], starts: Floats) -> Floats:
    """Place (3) and quaternion (4) of each `base_link` standing straight on the ground under its axles, (n, 7)."""
    x, y, yaw = starts.T
    wheelbase, half_track = np.array([[m.wheelbase_m, 0.5 * m.track_m] for m in models]).T
    ahead_x, ahead_y = wheelbase * np.cos(yaw), wheelbase * np.sin(yaw)
    left_x, left_y = -half_track * np.sin(yaw), half_track * np.cos(yaw)
    left, right = terrain.height(x + left_x, y + left_y), terrain.height(x - left_x, y - left_y)
    rear = 0.5 * (left + right)
    pitch = -np.arctan((terrain.height(x + ahead_x, y + ahead_y) - rear) / wheelbase)
    roll = np.arcsin(np.clip((left - right) / (2 * half_track) * np.cos(pitch), -1, 1))
    return np.stack([x, y, rear, *quaternion_from_rpy(roll, pitch, yaw)], axis=-1)


def _points(models: Sequence[MachineModel]) -> Floats:
    """The points of `bullet_scene.POINT_FRAME` in the links of their frames, (n, 5, 3)."""
    robots = [model.robot for model in models]
    return np.array([[*(r.place(w, r.joints[w].parent).xyz_m for w in WHEELS), np.zeros(3)] for r in robots])
