"""The PyBullet world: machine frames as rigid bodies; tyre and soil forces from outside.

Per wheel: load, traction, side force, rolling resistance, spin, brakes. Brush tyre with relaxation length sigma
(Pacejka, Tire and Vehicle Dynamics, ch. 7 and 8.5): slip stretches a bristle, u' = slip speed - |v| u / sigma, which
pulls with k u, k = stiffness * load / sigma. At steady slip s: the soil's slip stiffness times s, up to its traction.
At rest the bristles are springs. All arrays have the wheels' shape.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from protocol.arrays import Floats, Ints
from protocol.rotations import quaternion_from_rpy
from protocol.units import GRAVITY_MPS2
from sim.machines.chassis import (
    SETTLE_STEPS,
    STANDSTILL_MPS,
    TRACTION_USE,
    Bodies,
    chassis_of,
    drive_force_n,
    steering_radps,
)
from sim.machines.model import WHEELS, MachineModel
from sim.state import STEP_S, FleetState
from sim.terrain.terrain import C_RR, SLIP_STIFFNESS, TRACTION, Terrain
from sim.worlds.bullet_client import MultiBodies
from sim.worlds.bullet_scene import POINT_FRAME, DriveTrain, Weights, WheelGround, scene_at, state_from_scenes

BRISTLE_DAMPING = 0.3  # share of critical damping; no effect at steady slip
LONGEST_STRETCH = 2.5  # largest bristle stretch over the stretch whose tangent meets the traction limit
_NO_FORCE_N = 1e-6


@dataclass(frozen=True, slots=True)
class Actuators:
    """All (n,): articulation rate, drive force, brake force limit."""

    steering_radps: Floats
    drive_n: Floats
    brake_n: Floats


class BulletWorld:
    """n machines on one terrain, moved by PyBullet at 100 Hz.

    starts: x, y [m], yaw [rad] of each `base_link`, (n, 3).
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
        of_wheels += [np.broadcast_to(bodies.rolling, len(models))]
        self._tyres = Tyres(*(np.repeat(values[:, None], 4, axis=1) for values in of_wheels))
        # Free tyre radii: the nominal empty machine stands level, hubs at their radius.
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
        """Change one machine's payload."""
        self._multi.set_payload(machine, payload_kg)
        carried = self._weights.payload_kg.copy()  # past states keep theirs
        carried[machine] = payload_kg
        self._weights = Weights(self._bodies.mass_kg + carried, carried)

    def set_terrain(self, terrain: Terrain) -> None:
        """Replace the ground."""
        self._terrain = terrain

    def close(self) -> None:
        """Free PyBullet's client."""
        self._multi.close()

    def advance(self, steer_rad: Floats, drive_n: Floats, brake_n: Floats) -> FleetState:
        """Advance by STEP_S; all (n,): target articulation, drive force (signed), brake force limit."""
        self._actuators = self._follow_commands(steer_rad, drive_n, brake_n)

        # Ground forces at the current places.
        ground, load = self._scene.ground, self._wheel_load_n
        forces = self._roll(ground, load)
        along_wheel = np.stack([forces.traction_n + forces.resistance_n, forces.left_n, load], axis=-1)
        in_map = (along_wheel[..., None, :] @ ground.wheel_from_map)[..., 0, :]

        # The resulting motion.
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
        old = self._actuators
        steering = steering_radps(self._chassis, steer_rad, self.state.articulation_rad, old.steering_radps)
        least = TRACTION[self._scene.ground.zone].min(axis=-1)
        grip = TRACTION_USE * least * self.state.load_n
        return Actuators(steering, drive_force_n(self._chassis, drive_n, old.drive_n, grip), brake_n)

    def _loads(self, ground: WheelGround) -> Floats:
        return radial_load(self._tyres, self._free_radius_m - ground.gap_m, -ground.velocity_mps[..., 2])

    def _roll(self, ground: WheelGround, load: Floats) -> TyreForces:
        """Drive and brake torque are split by wheel load."""
        motion = WheelMotion(load, ground.velocity_mps[..., 0], ground.velocity_mps[..., 1], ground.zone)
        lever = load * (self._tyres.radius_m / np.maximum(load.sum(axis=-1, keepdims=True), 1.0))
        drive, brake = lever * self._actuators.drive_n[:, None], lever * self._actuators.brake_n[:, None]
        self._rolling, forces = turn_wheels(self._tyres, self._rolling, motion, drive, brake, STEP_S)
        return forces


def _standing(terrain: Terrain, models: Sequence[MachineModel], starts: Floats) -> Floats:
    """Position (3) and quaternion (4) of each upright `base_link`, (n, 7)."""
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
    """Points of `bullet_scene.POINT_FRAME` in their links, (n, 5, 3)."""
    robots = [model.robot for model in models]
    return np.array([[*(r.place(w, r.joints[w].parent).xyz_m for w in WHEELS), np.zeros(3)] for r in robots])


@dataclass(frozen=True, slots=True)
class Tyres:
    """Tyre parameters. radius: rolling radius; relates spin to speed and torque to force.

    rolling: factor on the soil's rolling resistance.
    """

    radius_m: Floats
    stiffness_npm: Floats
    damping_nspm: Floats
    relaxation_m: Floats
    inertia_kgm2: Floats
    rolling: Floats | float = 1.0


@dataclass(frozen=True, slots=True)
class TyreState:
    """Wheel spin, and bristle stretch ahead and to the left."""

    spin_radps: Floats
    ahead_m: Floats
    left_m: Floats


@dataclass(frozen=True, slots=True)
class WheelMotion:
    """Load [N], hub speed over ground ahead and to the left, soil zone."""

    load_n: Floats
    ahead_mps: Floats
    left_mps: Floats
    zone: Ints


@dataclass(frozen=True, slots=True)
class TyreForces:
    """Ground forces on wheels, and net torque of drive and brake.

    traction: ahead, without resistance. resistance: rolling, against the motion. left: sideways.
    """

    traction_n: Floats
    resistance_n: Floats
    left_n: Floats
    torque_nm: Floats


def at_rest(shape: tuple[int, ...]) -> TyreState:
    """Standing wheels with relaxed bristles."""
    return TyreState(np.zeros(shape), np.zeros(shape), np.zeros(shape))


def radial_load(tyres: Tyres, squash_m: Floats, squash_mps: Floats) -> Floats:
    """Load [N] of tyres from compression (negative: in the air) and its rate; never negative."""
    load = tyres.stiffness_npm * squash_m + tyres.damping_nspm * squash_mps
    return np.where(squash_m > 0, np.maximum(load, 0.0), 0.0)


def turn_wheels(
    tyres: Tyres, state: TyreState, motion: WheelMotion, drive_nm: Floats, brake_nm: Floats, dt: float
) -> tuple[TyreState, TyreForces]:
    """Turn wheels by one step. drive_nm: torque per wheel. brake_nm: limit.

    Spin and bristles are one stiff system: one implicit step, bristle stiffness from its start.
    """
    load, zone, radius = motion.load_n, motion.zone, tyres.radius_m
    limit = TRACTION[zone] * load
    stiffness = SLIP_STIFFNESS[zone] * load / tyres.relaxation_m
    damping = (2 * BRISTLE_DAMPING) * np.sqrt(stiffness * load / GRAVITY_MPS2)

    # Share of the spring force left near the traction limit, both directions combined.
    pull = stiffness * np.hypot(state.ahead_m, state.left_m) + _NO_FORCE_N
    limit_or_one = np.maximum(limit, 1.0)
    share = limit * np.tanh(pull / limit_or_one) / pull

    # New stretch = (stretch + dt * slip speed) * keep; force = hard * stretch - soft * old stretch.
    rolling = np.maximum(np.abs(motion.ahead_mps), np.abs(state.spin_radps * radius))
    keep = 1 / (1 + rolling * (dt / tyres.relaxation_m))
    soft = share * damping / dt
    hard = share * stiffness + soft

    # Spin: the bristle force is linear in it. Then the brake, limited by standstill.
    gain = hard * keep
    at_still = gain * (state.ahead_m - dt * motion.ahead_mps) - soft * state.ahead_m
    inertia = tyres.inertia_kgm2 + gain * (dt * radius) ** 2
    free = (tyres.inertia_kgm2 * state.spin_radps + dt * (drive_nm - radius * at_still)) / inertia
    spin = free - np.clip(free, -dt * brake_nm / inertia, dt * brake_nm / inertia)

    ahead = keep * (state.ahead_m + dt * (spin * radius - motion.ahead_mps))
    left = keep * (state.left_m - dt * motion.left_mps)
    traction = hard * ahead - soft * state.ahead_m
    side = hard * left - soft * state.left_m
    within = np.minimum(1.0, limit / (np.hypot(traction, side) + _NO_FORCE_N))
    slack = np.minimum(1.0, LONGEST_STRETCH * limit / (stiffness * np.hypot(ahead, left) + _NO_FORCE_N))
    resistance = -tyres.rolling * C_RR[zone] * load * np.tanh(motion.ahead_mps / STANDSTILL_MPS)
    resistance = np.where(spin == 0.0, 0.0, resistance)  # a locked wheel does not roll
    torque = drive_nm - (free - spin) * inertia / dt
    forces = TyreForces(within * traction, resistance, within * side, torque)
    return TyreState(spin, slack * ahead, slack * left), forces
