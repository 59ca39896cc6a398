"""The fast fleet model: a `World` of articulated loaders that follow routes, for up to hundreds of machines."""

from __future__ import annotations

import numpy as np

from sim.driver import Drivers, drive, lay_course
from sim.routes import Route
from sim.terrain import Terrain
from sim.vehicle import Bodies, advance, standing
from sim.world import STEP_S, FleetState


class Fleet:
    """A `World` without PyBullet. routes: one per machine; each starts at rest on its first point."""

    def __init__(self, terrain: Terrain, bodies: Bodies, routes: list[Route], drive_mps: float) -> None:
        self._terrain, self._bodies = terrain, bodies
        self._course = lay_course(routes, drive_mps)
        start = np.zeros(len(routes))
        self._drivers = Drivers(start, start)
        points, direction = self._course.at(start)
        yaw = np.arctan2(direction[:, 1], direction[:, 0])
        self._state = standing(bodies, terrain, points[:, 0], points[:, 1], yaw)

    @property
    def state(self) -> FleetState:
        """The state after the last step."""
        return self._state

    def step(self) -> FleetState:
        """Advance by STEP_S and return the new state."""
        self._drivers, steer, force = drive(self._course, self._drivers, self._state, STEP_S)
        self._state = advance(self._bodies, self._terrain, self._state, steer, force, STEP_S)
        return self._state
