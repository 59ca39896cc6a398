"""Interface of the worlds `bullet` and `fast`."""

from __future__ import annotations

from typing import Protocol

from protocol.arrays import Floats
from sim.state import FleetState
from sim.terrain.terrain import Terrain


class World(Protocol):
    """Moves all machines of a site; they start straight, empty, at rest.

    state: after the last step.
    """

    state: FleetState

    def advance(self, steer_rad: Floats, drive_n: Floats, brake_n: Floats) -> FleetState:
        """Advance by STEP_S; all (n,): target articulation, drive force (signed), brake force limit."""
        ...

    def set_payload(self, machine: int, payload_kg: float) -> None:
        """Change one machine's payload."""
        ...

    def set_terrain(self, terrain: Terrain) -> None:
        """Replace the ground."""
        ...

    def close(self) -> None:
        """Free resources."""
        ...
