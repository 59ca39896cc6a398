"""Options of localisation, the table [pipeline.localisation]."""

import math
from dataclasses import dataclass

FILTERS = ("ekf", "ukf")
PROFILES = ("default", "paper")


@dataclass(frozen=True)
class LocalisationConfig:
    """How positions are found.

    filter: ekf or ukf. profile: "paper" takes GPS errors as white; "default" estimates a slow error of each receiver, a
    bias of each yaw gyro and the wheels' scale. start: x, y [m] and heading [rad] in `map`, where they are known: no
    alignment is needed then, nor GPS. slip, slip_soft: wheel slip per traction on firm ground, and how much it rises
    with the rolling resistance; of the tyres.
    """

    filter: str = "ukf"
    profile: str = "default"
    start: tuple[float, ...] = ()
    slip: float = 0.1
    slip_soft: float = 0.9

    def __post_init__(self) -> None:
        if self.filter not in FILTERS:
            raise ValueError(f"filter: {self.filter!r} is neither {' nor '.join(FILTERS)}")
        if self.profile not in PROFILES:
            raise ValueError(f"profile: {self.profile!r} is neither {' nor '.join(PROFILES)}")
        if not (0 <= self.slip < 1 and 0 <= self.slip_soft < math.inf):
            raise ValueError("slip: must be from 0 to below 1, slip_soft not negative")
        if len(self.start) not in (0, 3) or not all(map(math.isfinite, self.start)):
            raise ValueError("start: must be x, y and heading, or empty")
