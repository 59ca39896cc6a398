"""What lies between engine or motor and the wheels: [machine.powertrain], where torque is not read at the wheels."""

from collections.abc import Collection
from dataclasses import dataclass

from protocol.config import require_between


@dataclass(frozen=True)
class PowertrainConfig:
    """Powertrain of a machine, as its data sheets state it.

    reference_torque_nm: what 100 % torque of the engine is (SPN 544). losses: friction and auxiliary drives, as a share
    of it, where no reading states them. gears, reverse_gears: turns of engine or motor per turn of the gearbox's
    output; final_drive: of those per turn of a wheel, axles and hubs together. efficiency: from engine or motor to the
    wheels. idle_pressure_pa: of hydraulics that the engine drives; above it they draw an unknown share. 0: it has none.
    """

    reference_torque_nm: float = 0.0
    losses: float = 0.0
    gears: tuple[float, ...] = (1.0,)
    reverse_gears: tuple[float, ...] = ()
    final_drive: float = 1.0
    efficiency: float = 0.95
    idle_pressure_pa: float = 0.0

    def __post_init__(self) -> None:
        require_between(self, 0, 1e5, "reference_torque_nm")
        require_between(self, 0, 0.5, "losses")
        require_between(self, 0.1, 500, "final_drive")
        require_between(self, 0.3, 1, "efficiency")
        require_between(self, 0, 1e8, "idle_pressure_pa")
        for name, ratios in (("gears", self.gears), ("reverse_gears", self.reverse_gears)):
            if wrong := [ratio for ratio in ratios if not 0.05 <= ratio <= 100]:
                raise ValueError(
                    f"{name}: {wrong[0]:g} is no ratio from 0.05 to 100 (those of reverse gears are positive too)"
                )
        if not self.gears:
            raise ValueError("gears: none; a machine without a gearbox has one, [1.0]")

    def lacks(self, kinds: Collection[str]) -> str:
        """What sensors of these kinds need of it and it does not state, in a sentence; empty where all is there."""
        if "engine" in kinds and not self.reference_torque_nm:
            return "reference_torque_nm: an engine states its torque as a share of it: its plate or data sheet has it"
        if "motor" in kinds and len(self.gears) > 1:
            return "gears: a motor states no speed that would show its gear: give one, of motor to final drive"
        return ""
