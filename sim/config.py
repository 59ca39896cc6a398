"""Options of a simulation run, as `config/sim.toml` describes them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from protocol.config import from_table, load_toml
from protocol.readings import MAX_STAMP_NS
from protocol.site import NAME

STEP_MS = 10  # the world runs at 100 Hz


@dataclass(frozen=True)
class SimConfig:
    """What is simulated, and how fast.

    seconds: simulated time, 0 runs until stopped. speed: times real time, 0 as fast as possible. names: default
    `loader-1`, `loader-2`, ... gps, imus: receivers and IMUs of each machine. outage_s of every outage_period_s each
    receiver is silent. gps_*_std_m: per horizontal axis; the vertical is worse (`sensors.GPS_VERTICAL`). wait_s: how
    long to wait for a subscriber of every machine before driving.
    """

    site: str = "paper"
    machines: int = 3
    names: tuple[str, ...] = ()
    seed: int = 0
    seconds: float = 120.0
    speed: float = 1.0
    drive_mps: float = 4.0
    gps: int = 2
    imus: int = 1
    outage_s: float = 1.0
    outage_period_s: float = 10.0
    gps_drift_std_m: float = 1.2
    gps_drift_time_s: float = 60.0
    gps_white_std_m: float = 0.7
    roughness_m: float = 0.01
    bundle_ms: int = 50
    start_ns: int = 1_767_225_600_000_000_000  # 2026-01-01T00:00:00Z
    wait_s: float = 30.0

    def __post_init__(self) -> None:
        self._check_names()
        limits = {
            "machines": (1, 1000),
            "seed": (0, 2**63),
            "seconds": (0, 1e7),
            "speed": (0, 1e3),
            "drive_mps": (0.5, 8),
            "gps": (0, 3),
            "imus": (1, 3),
            "outage_s": (0, 1e6),
            "outage_period_s": (0.1, 1e6),
            "gps_drift_std_m": (0, 100),
            "gps_drift_time_s": (0.1, 1e6),
            "gps_white_std_m": (0, 100),
            "roughness_m": (0, 0.1),
            "bundle_ms": (STEP_MS, 1000),
            "start_ns": (1, MAX_STAMP_NS - 10**16),
            "wait_s": (0, 1e6),
        }
        for name, (low, high) in limits.items():
            if not low <= getattr(self, name) <= high:  # also false for NaN
                raise ValueError(f"{name}: {getattr(self, name)!r} is not between {low:g} and {high:g}")
        if self.bundle_ms % STEP_MS:
            raise ValueError(f"bundle_ms: {self.bundle_ms} is not a multiple of {STEP_MS}")
        if self.outage_s > self.outage_period_s:
            raise ValueError(f"outage_s: {self.outage_s} is longer than outage_period_s")

    def _check_names(self) -> None:
        if not NAME.fullmatch(self.site):
            raise ValueError(f"site: {self.site!r} is not a name (lower-case letters, digits, - and _)")
        if self.names and len(self.names) != self.machines:
            raise ValueError(f"names: {len(self.names)} names for {self.machines} machines")
        for name in self.names:
            if not NAME.fullmatch(name):
                raise ValueError(f"names: {name!r} is not a name (lower-case letters, digits, - and _)")
        if len(set(self.names)) < len(self.names):
            raise ValueError("names: two machines have the same name")

    @property
    def machine_names(self) -> tuple[str, ...]:
        """Name of every machine."""
        return self.names or tuple(f"loader-{i + 1}" for i in range(self.machines))

    @property
    def bundles(self) -> int | None:
        """How many bundles the run has; None if it ends only when it is stopped."""
        return -int(-self.seconds * 1000 // self.bundle_ms) if self.seconds else None


def load_sim(path: Path) -> SimConfig:
    """Read a `sim.toml`."""
    return from_table(SimConfig, load_toml(path), str(path))
