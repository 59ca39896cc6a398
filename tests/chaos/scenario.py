"""What every scenario is given, and what it draws from the seed."""

from __future__ import annotations

import random
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.chaos.chaos_site import ChaosSite
from tests.chaos.outcome import Console
from tests.chaos.recordings import Recordings

# Snapshots every few seconds, so that they are written under faults too; the audit would exclude machines.
SERVER_TOML = """
[store]
snapshot_s = 2.0
[trust]
exclude = false
"""


@dataclass(frozen=True)
class FaultRun:
    """One fault's run.

    folder: its own. seconds: how long faults strike. scale: how much of the whole suite, 0 to 1. strikes: how often to
    strike, where that can be said; 0 for what scale gives.
    """

    fault: str
    folder: Path
    recordings: Recordings
    console: Console
    seed: int
    seconds: float
    scale: float = 1.0
    strikes: int = 0

    @property
    def rng(self) -> random.Random:
        """Random numbers of this fault alone: the same whatever else runs."""
        return random.Random(f"{self.seed} {self.fault}")

    def site(self, **options: Any) -> ChaosSite:
        """Return a site, not yet started."""
        return ChaosSite(self.folder, self.recordings, self.console, server_toml=SERVER_TOML, **options)

    def say(self, text: str) -> None:
        """Print a line."""
        self.console.say(f"{self.fault}: {text}")
