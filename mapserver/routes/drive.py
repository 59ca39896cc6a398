"""Speed, energy and time of a drive along a line over ground of known resistance and slope.

The machine is a point mass. It keeps below its own speed and the limit of curves, accelerates within its power, and
brakes in time. Per step of length d:

    drive force  F = m g (c + s) + m k a,    a = (v1^2 - v0^2) / 2 d

with rolling resistance c, slope s along the line, acceleration a, and k >= 1 for rotating parts. The engine does the
work of F > 0; brakes take that of F < 0. A driver answers a change of m g (c + s) after LATE_S and makes up for the
speed gained or lost; half of it, 1/2 v LATE_S |change|, is lost in brakes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np

from protocol.arrays import Floats
from protocol.queries.routing import RouteMachine
from protocol.units import GRAVITY_MPS2

CREEP_MPS = 0.3  # slowest driving [m/s]: what the power cannot do at this speed, it cannot do
LATE_S = 0.3  # seconds; fitted to simulated drives over soil patches: without it energies are 3 % too low
SMOOTH_M = 9.0  # metres of smoothing, about a machine's length, because it stands on all of it


@dataclass(frozen=True)
class Drive:
    """A drive of n steps.

    speed_mps (n + 1,): at their ends. energy_j, braked_j (n,): of engine and brakes. time_s (n,). stalls: first step
    beyond the machine's power, or -1.
    """

    speed_mps: Floats
    energy_j: Floats
    braked_j: Floats
    time_s: Floats
    stalls: int


def smoothed(values: Floats, step_m: float) -> Floats:
    """Moving average of values (n,) over SMOOTH_M, shorter at the ends."""
    half = min(round(SMOOTH_M / step_m) // 2, max(len(values) - 1, 0))
    sums = np.concatenate([[0.0], np.cumsum(values)])
    at = np.arange(len(values))
    first, end = np.maximum(at - half, 0), np.minimum(at + half + 1, len(values))
    mean: Floats = (sums[end] - sums[first]) / (end - first)
    return mean


def drive(step_m: Floats, resistance: Floats, slope: Floats, limit_mps: Floats, machine: RouteMachine) -> Drive:
    """Drive n steps (n,) as fast as limits and machine allow.

    limit_mps (n + 1,): at the ends of steps, 0 to stop. resistance, slope: along the line, smoothed.
    """
    force_n = machine.mass_kg * GRAVITY_MPS2 * (resistance + slope)
    limit = np.minimum(limit_mps, machine.speed_mps)
    inertia_kg = machine.mass_kg * machine.rotating
    limits = machine.power_w, machine.accelerate_mps2, machine.brake_mps2, LATE_S
    speed, energy, braked, time = (np.zeros(len(step_m) + extra) for extra in (1, 0, 0, 0))
    stalls = _drive(step_m, force_n, limit, inertia_kg, limits, speed, energy, braked, time)
    return Drive(speed, energy, braked, time, stalls)


@numba.njit(cache=True, nogil=True)
def _drive(
    step_m: Any,
    force_n: Any,
    limit: Any,
    inertia_kg: float,
    limits: Any,
    speed: Any,
    energy: Any,
    braked: Any,
    time: Any,
) -> int:
    power_w, accelerate, brake, late = limits
    n = len(step_m)
    # backward pass: speeds from which brakes stop in time
    speed[n] = limit[n]
    for i in range(n - 1, -1, -1):
        speed[i] = min(limit[i], math.sqrt(speed[i + 1] ** 2 + 2 * brake * step_m[i]))
    # forward pass: speeds that the engine reaches
    stalls = -1
    for i in range(n):
        v, d = speed[i], step_m[i]
        wanted = min(speed[i + 1], math.sqrt(v * v + 2 * accelerate * d))
        reached = _reached(v, wanted, d, force_n[i], inertia_kg, power_w)
        least = min(CREEP_MPS, limit[i + 1])
        if reached < least:
            if stalls < 0 and force_n[i] * max(CREEP_MPS, v) > power_w:
                stalls = i
            reached = least
        speed[i + 1] = reached
        work = force_n[i] * d + 0.5 * inertia_kg * (reached * reached - v * v)
        energy[i], braked[i] = max(work, 0.0), max(-work, 0.0)
        if i > 0 and max(force_n[i], force_n[i - 1]) > 0.0:
            lost = 0.5 * late * v * abs(force_n[i] - force_n[i - 1])
            energy[i], braked[i] = energy[i] + lost, braked[i] + lost
        time[i] = 2 * d / max(v + reached, CREEP_MPS)
    return stalls


@numba.njit(cache=True, nogil=True)
def _reached(v: float, wanted: float, d: float, force_n: float, inertia_kg: float, power_w: float) -> float:
    """Speed at the end of a step: as wanted, or as far as the power goes."""
    low, high = 0.0, wanted
    if _spare(v, high, d, force_n, inertia_kg, power_w) >= 0.0:
        return high
    for _ in range(40):  # spare work falls with the speed reached
        middle = 0.5 * (low + high)
        if _spare(v, middle, d, force_n, inertia_kg, power_w) >= 0.0:
            low = middle
        else:
            high = middle
    return low


@numba.njit(cache=True, nogil=True)
def _spare(v: float, reached: float, d: float, force_n: float, inertia_kg: float, power_w: float) -> float:
    """Work [J] the engine could do in a step, less the work needed."""
    mean = 0.5 * (v + reached)
    if mean <= 0.0:
        return math.inf
    return power_w * d / mean - (force_n * d + 0.5 * inertia_kg * (reached * reached - v * v))
