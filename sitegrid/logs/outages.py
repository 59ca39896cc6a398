"""When fixes are withheld from the filter, for comparison with its positions."""

from __future__ import annotations

from dataclasses import dataclass

from agents.holdout import HoldoutConfig


@dataclass(frozen=True)
class Outage:
    """One outage of length_s at start_s after the first reading."""

    start_s: float
    length_s: float

    def withholds(self, seconds: float) -> bool:
        """Whether GPS is withheld at this time after the first reading."""
        return 0 <= seconds - self.start_s < self.length_s

    def __str__(self) -> str:
        return f"{self.start_s:g},{self.length_s:g}"


@dataclass(frozen=True)
class Periodic(HoldoutConfig):
    """GPS is withheld for off_s of every period_s."""

    def __str__(self) -> str:
        return f"{self.off_s:g}/{self.period_s:g}"


Pattern = Outage | Periodic | None  # None: nothing is withheld
WITHHOLD: tuple[Pattern, ...] = (None, Periodic(10.0, 1.0), Periodic(30.0, 10.0), Periodic(60.0, 30.0))


def parse_pattern(kind: str, first_s: float, second_s: float) -> Pattern:
    """Parse `--withhold`: `/` separates outage and period, `,` start and length."""
    if kind == "/":
        return Periodic(period_s=second_s, off_s=first_s)
    return Outage(first_s, second_s) if kind == "," else None
