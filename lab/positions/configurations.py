"""Configurations of the paper's table as pipeline options: filter, sensors, profile."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from agents.localisation.localiser import LocalisationConfig
from agents.localisation.tuning import TUNING, LocalisationTuning
from agents.positioning import PipelineConfig
from lab.positions.published import POSITIONS, Group

FILTERS = ("ekf", "ukf")
PROFILES = ("paper", "default")
SENSORS = ((0, 1), (1, 1), (1, 2), (1, 3), (2, 1), (2, 2), (2, 3), (3, 3), (3, 1))  # GPS, IMU; the last is ours
HEADLINE = ((1, 1), (2, 1), (3, 1))


@dataclass(frozen=True)
class Configuration:
    """A row: filter, numbers of GPS receivers and IMUs, profile.

    machine_share: common share of slow GPS error variance; None: as recorded.
    """

    filter: str
    gps: int
    imu: int
    profile: str
    machine_share: float | None = None

    @property
    def name(self) -> str:
        """Name for files."""
        share = "" if self.machine_share is None else f"-{self.machine_share:g}shared"
        return f"{self.filter}-{self.profile}-{self.gps}gps-{self.imu}imu{share}"

    @property
    def group(self) -> Group:
        """The paper's group."""
        return self.filter, self.gps, self.imu

    @property
    def sensors(self) -> tuple[int, int, float | None]:
        """GPS receivers, IMUs, machine_share."""
        return self.gps, self.imu, self.machine_share

    @property
    def options(self) -> PipelineConfig:
        """Pipeline options."""
        return PipelineConfig(localisation=LocalisationConfig(filter=self.filter, profile=self.profile))

    @property
    def tuning(self) -> LocalisationTuning:
        """Tuning of localisation."""
        return TUNING

    @property
    def published_net_m(self) -> float | None:
        """Published net RMSE [m] for either profile; None without such a row."""
        published = POSITIONS.get(self.group)
        return published.net_m if published else None


def configurations(
    sensors: Sequence[tuple[int, int]] = SENSORS, shares: Sequence[float | None] = (None,)
) -> list[Configuration]:
    """All rows: both filters and profiles per set of sensors, share by share."""
    return [
        Configuration(f, gps, imu, p, share)
        for share in shares
        for gps, imu in sensors
        if gps or share == shares[0]  # without receivers nothing is shared
        for p in PROFILES
        for f in FILTERS
    ]
