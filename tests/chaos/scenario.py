"""Input of every scenario, and its draws from the seed."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.chaos.chaos_site import ChaosSite
from tests.chaos.outcome import Console, FaultOutcome
from tests.chaos.recordings import Recordings


@dataclass(frozen=True)
class Spell:
    """A fault that lasts for the block."""

    words: str
    lasts_s: float
    block: AbstractContextManager[None]


@dataclass(frozen=True)
class FaultRun:
    """One fault's run.

    folder: its own. seconds: of faults. scale: share of the whole suite, 0 to 1. strikes: number of strikes, 0: by
    scale.
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
        """Generator of this fault, independent of the others."""
        return random.Random(f"{self.seed} {self.fault}")

    def site(self, **options: Any) -> ChaosSite:
        return ChaosSite(self.folder, self.recordings, self.console, **options)

    def say(self, text: str) -> None:
        self.console.say(f"{self.fault}: {text}")

    def strike(
        self, site: ChaosSite, draw: Callable[[random.Random, int], Spell], counts: Sequence[int] | None = None
    ) -> FaultOutcome:
        """Start a site and strike repeatedly with pauses. counts: per spell, default 1."""
        rng, left_s, n = self.rng, self.seconds, 0
        site.start_all()
        while left_s > 0:
            spell, pause_s = draw(rng, n), rng.uniform(0.5, 1.5)
            lasts_s = min(spell.lasts_s, max(1.0, left_s))
            self.say(f"{spell.words} for {lasts_s:.1f} s")
            site.linger(pause_s)
            with site.fault(), spell.block:
                site.linger(lasts_s)
            left_s, n = left_s - pause_s - lasts_s, n + 1
        site.outcome.notes["spells"] = n
        return site.finish(self.fault, n if counts is None else sum(counts))
