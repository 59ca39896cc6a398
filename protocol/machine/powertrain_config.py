"""[machine.powertrain]: between engine or motor and the wheels, where torque is not read."""

from collections.abc import Collection
from dataclasses import dataclass

from protocol.config import require_between


@dataclass(frozen=True)
class PowertrainConfig:
    """A powertrain by data sheet.

    reference_torque_nm: 100 % engine torque (SPN 544). losses: friction and auxiliary drives, as a share of it, if not
    read. gears, reverse_gears: engine or motor turns per gearbox output turn; final_drive: output turns per wheel turn,
    axles and hubs together. efficiency: engine or motor to wheels. idle_pressure_pa: of engine-driven hydraulics; above
    it their share is unknown. retarder_torque_nm: 100 % retarder torque at the gearbox output. 0: none, unknown.
    """

    reference_torque_nm: float = 0.0
    losses: float = 0.0
    gears: tuple[float, ...] = (1.0,)
    reverse_gears: tuple[float, ...] = ()
    final_drive: float = 1.0
    efficiency: float = 0.95
    idle_pressure_pa: float = 0.0
    retarder_torque_nm: float = 0.0

    def __post_init__(self) -> None:
        require_between(self, 0, 1e5, "reference_torque_nm", "retarder_torque_nm")
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
        """What sensors of these kinds need and it lacks, as a sentence, or ""."""
        if "engine" in kinds and not self.reference_torque_nm:
            return "reference_torque_nm: an engine states its torque as a share of it: its plate or data sheet has it"
        if "motor" in kinds and len(self.gears) > 1:
            return "gears: a motor states no speed that would show its gear: give one, of motor to final drive"
        return ""
