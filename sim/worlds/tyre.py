"""Tyres on soil, for all wheels at once: load, traction, side force, rolling resistance, spin and brakes.

A brush tyre with relaxation length (Pacejka, Tire and Vehicle Dynamics, ch. 7 and 8.5): the tread is a bristle that the
slip stretches, u' = slip speed - |v| u / sigma, and that pulls with k u, k = stiffness * load / sigma. At a steady slip
s this is the soil's slip stiffness times s; it levels off at the soil's traction, and at rest the bristles hold
the machine like springs. All arrays have one shape, that of the wheels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from protocol.arrays import Floats, Ints
from protocol.units import GRAVITY_MPS2
from sim.machines.chassis import STANDSTILL_MPS
from sim.terrain.soil import C_RR, SLIP_STIFFNESS, TRACTION

BRISTLE_DAMPING = 0.3  # of a wheel's share of the machine on its bristles, against critical; nothing at steady slip
LONGEST_STRETCH = 2.5  # of a bristle, against where its tangent meets the traction limit: then the tread slides
_NO_FORCE_N = 1e-6


@dataclass(frozen=True, slots=True)
class Tyres:
    """Parameters of wheels. radius: the rolling radius, that relates spin to speed and torque to force."""

    radius_m: Floats
    stiffness_npm: Floats
    damping_nspm: Floats
    relaxation_m: Floats
    inertia_kgm2: Floats


@dataclass(frozen=True, slots=True)
class TyreState:
    """State of wheels: spin, and the bristles' stretch ahead and to the left."""

    spin_radps: Floats
    ahead_m: Floats
    left_m: Floats


@dataclass(frozen=True, slots=True)
class WheelMotion:
    """How wheels touch the ground: load [N], speed of the hub over it, ahead and to the left, and the soil's zone."""

    load_n: Floats
    ahead_mps: Floats
    left_mps: Floats
    zone: Ints


@dataclass(frozen=True, slots=True)
class TyreForces:
    """Forces of the ground on wheels, and the net torque of drive and brake.

    traction: ahead, without resistance: the rolling resistance, against the motion. left: sideways.
    """

    traction_n: Floats
    resistance_n: Floats
    left_n: Floats
    torque_nm: Floats


def at_rest(shape: tuple[int, ...]) -> TyreState:
    """Wheels that stand, bristles relaxed."""
    return TyreState(np.zeros(shape), np.zeros(shape), np.zeros(shape))


def radial_load(tyres: Tyres, squash_m: Floats, squash_mps: Floats) -> Floats:
    """Load [N] of tyres squashed so far (negative: in the air) and at this rate; the ground never pulls."""
    load = tyres.stiffness_npm * squash_m + tyres.damping_nspm * squash_mps
    return np.where(squash_m > 0, np.maximum(load, 0.0), 0.0)


def turn_wheels(
    tyres: Tyres, state: TyreState, motion: WheelMotion, drive_nm: Floats, brake_nm: Floats, dt: float
) -> tuple[TyreState, TyreForces]:
    """Turn wheels by one step. drive_nm: torque on each wheel; brake_nm: the most its brake can hold.

    Spin and bristles are one stiff system: stepped implicitly with the bristles' stiffness of the step's start.
    """
    load, zone, radius = motion.load_n, motion.zone, tyres.radius_m
    limit = TRACTION[zone] * load
    stiffness = SLIP_STIFFNESS[zone] * load / tyres.relaxation_m
    damping = (2 * BRISTLE_DAMPING) * np.sqrt(stiffness * load / GRAVITY_MPS2)

    # Share of the spring's force that is left near the traction limit, ahead and sideways together.
    pull = stiffness * np.hypot(state.ahead_m, state.left_m) + _NO_FORCE_N
    limit_or_one = np.maximum(limit, 1.0)
    share = limit * np.tanh(pull / limit_or_one) / pull

    # A stretch changes to (stretch + dt * slip speed) * keep and pulls with hard * stretch - soft * old stretch.
    rolling = np.maximum(np.abs(motion.ahead_mps), np.abs(state.spin_radps * radius))
    keep = 1 / (1 + rolling * (dt / tyres.relaxation_m))
    soft = share * damping / dt
    hard = share * stiffness + soft

    # Spin: the bristles' pull is linear in it; the brake then takes what it can, down to standstill.
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
    resistance = -C_RR[zone] * load * np.tanh(motion.ahead_mps / STANDSTILL_MPS)
    resistance = np.where(spin == 0.0, 0.0, resistance)  # a locked wheel does not roll
    torque = drive_nm - (free - spin) * inertia / dt
    forces = TyreForces(within * traction, resistance, within * side, torque)
    return TyreState(spin, slack * ahead, slack * left), forces
