"""What kind of world a seed makes: its faults, and how likely each of them is."""

from __future__ import annotations

import random
from dataclasses import dataclass


@dataclass(frozen=True)
class Rates:
    """How likely each fault is, and what kind of site this is; drawn from the seed."""

    lost: float
    late: float
    twice: float
    reply_lost: float
    server_fault: float
    spool_fault: float
    bad_sample: float
    pending: bool
    copies: bool
    server_backups: bool
    max_samples: int
    wall_clock: bool
    machines: int
    steps: int


def draw_rates(rng: random.Random) -> Rates:
    """Every kind of fault is absent in some worlds, so that those that remain are met alone."""

    def some(most: float) -> float:
        return rng.choice((0.0, rng.uniform(0, most)))

    return Rates(
        lost=some(0.5),
        late=some(0.5),
        twice=some(0.4),
        reply_lost=some(0.5),
        server_fault=some(0.4),
        spool_fault=some(0.3),
        bad_sample=some(0.15),
        pending=rng.random() < 0.3,
        copies=rng.random() < 0.5,
        server_backups=rng.random() < 0.3,
        max_samples=rng.choice((10_000, 10_000, 20, 6)),
        wall_clock=rng.random() < 0.2,
        machines=rng.choice((1, 1, 2)),
        steps=rng.randint(20, 80),
    )
