"""Waiting for others: how far the leg ahead of a machine is clear of other machines, now and in a moment."""

from __future__ import annotations

import numpy as np

from protocol.arrays import Floats, Ints
from sim.operators.course import BEYOND_M, Course
from sim.operators.crew import Crew
from sim.state import FleetState

LOOK_OUT_STEPS = 20  # of the world: drivers look about at 5 Hz
OVERHANG_M = 2.2  # of frame or bucket beyond an axle
CLEARANCE_M = 3.6  # between a leg and the middle of another machine: two half widths and a margin
DISTANCE_M = 3.0  # that is kept to a machine ahead
APART_M = 12.0  # between the joints of machines at the start
PROSPECT_S = (0.0, 1.5, 3.0)  # where others will be, if they go straight on
AHEAD_M = np.arange(2.0, BEYOND_M + 1e-9, 2.0)


def clear_distance(course: Course, crew: Crew, leg: Ints, distance_m: Floats, state: FleetState) -> Floats:
    """Distance (n,) [m] that each machine can drive before it meets another; infinite where none is near its leg.

    Of two machines that block each other the one that is nearer to meeting the other goes first.
    """
    n, travel, joint_m = len(distance_m), course.travel[leg], crew.joint_m(state)
    heading = np.stack([np.cos(state.yaw_rad), np.sin(state.yaw_rad)], axis=-1)
    front, rear = crew.front_to_joint_m + OVERHANG_M, crew.rear_to_joint_m + OVERHANG_M
    along = [np.zeros(n), front, -rear]
    spots = [offset + state.speed_mps * s for s in PROSPECT_S for offset in along]
    others = np.stack([joint_m + heading * spot[:, None] for spot in spots], axis=1)  # (n, spots, 2)

    path = np.stack([course.at(leg, distance_m + ahead)[0] for ahead in AHEAD_M], axis=1)  # (n, ahead, 2)
    nose = np.where(travel > 0, front, rear)
    gap = np.hypot(*(path[:, None, :, None] - others[None, :, None]).transpose(4, 0, 1, 2, 3)).min(axis=-1)
    blocked = gap < CLEARANCE_M  # (machine, other, ahead)
    blocked[np.arange(n), np.arange(n)] = False
    first = np.where(blocked.any(axis=-1), AHEAD_M[blocked.argmax(axis=-1)], np.inf)
    nearer = (first < first.T) | ((first == first.T) & (np.arange(n)[:, None] < np.arange(n)))
    first[np.isfinite(first.T) & nearer] = np.inf
    clear: Floats = np.maximum(first.min(axis=1) - nose - DISTANCE_M, 0.0)
    return clear
