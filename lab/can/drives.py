"""Recordings of fleets whose drive trains speak J1939, on random patches of soil."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace

from lab.calibration.drives import Agent
from lab.campaign.recordings import Setup
from lab.roads.drives import RoadDrive, inline
from sim.scenario.file import load_scenario

WORLD = "fast"  # PyBullet takes ten times as long, and moves loads and tyres, not drive trains


@dataclass(frozen=True)
class BusDrive(RoadDrive):
    """All machines of a scenario.

    can: whether they are read by their buses, or at the wheels. reference: what the first one's reference torque is
    stated as, over what it is. blind: no agent knows how its pump loads the engine; it has the same recording.
    """

    can: bool = True
    reference: float = 1.0
    blind: bool = field(default=False, repr=False)

    @property
    def scenario_toml(self) -> str:
        """The scenario file of this drive."""
        scenario = load_scenario(self.setup.scenario)
        fleets = [asdict(replace(fleet, can=self.can, preset=self.preset)) for fleet in scenario.fleet]
        top = {"world": WORLD, "fleet": fleets}
        if self.reference != 1.0:
            top["fault"] = [{"machine": scenario.machine_names[0], "torque_scale": self.reference}]
        return super().scenario_toml + "".join(f"{name} = {inline(value)}\n" for name, value in top.items())

    def agent(self, index: int) -> Agent:
        """The agent of a machine."""
        return Agent(index, closed_tours=True, blind=self.blind)


def planned(
    scenario: str, seed: int, seconds: float, *, can: bool, reference: float, blind: bool, preset: str
) -> BusDrive:
    """A drive of a scenario with the sensors of a preset, or with those that its file has."""
    setup = Setup(scenario, (), (), ())
    preset = preset or load_scenario(scenario).fleet[0].preset
    return BusDrive(seed, seconds, preset, setup, can=can, reference=reference, blind=blind)
