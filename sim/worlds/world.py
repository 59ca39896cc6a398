"""What a world offers that moves machines; there are two of them, `bullet` and `fast`."""

from __future__ import annotations

from typing import Protocol

from protocol.arrays import Floats
from sim.state import FleetState
from sim.terrain.terrain import Terrain


class World(Protocol):
    """Moves all machines of a site, under the commands of their drivers; they start straight, empty and at rest.

    state: after the last step.
    """

    state: FleetState

    def advance(self, steer_rad: Floats, drive_n: Floats, brake_n: Floats) -> FleetState:
        """Advance by STEP_S; all (n,): articulation to aim at, drive force (signed), most force of the brakes."""
        ...

    def set_payload(self, machine: int, payload_kg: float) -> None:
        """Change what one machine carries."""
        ...

    def set_terrain(self, terrain: Terrain) -> None:
        """Change the ground under the machines."""
        ...

    def close(self) -> None:
        """Free what the world holds."""
        ...
