"""When fixes are withheld from the filter, to be compared with its positions afterwards."""

from __future__ import annotations

from dataclasses import dataclass

from agents.holdout import HoldoutConfig


@dataclass(frozen=True)
class Outage:
    """GPS is withheld once, for length_s from start_s on, counted from the first reading."""

    start_s: float
    length_s: float

    def withholds(self, seconds: float) -> bool:
        """Whether GPS is withheld so many seconds after the first reading."""
        return 0 <= seconds - self.start_s < self.length_s

    def __str__(self) -> str:
        return f"{self.start_s:g},{self.length_s:g}"


@dataclass(frozen=True)
class Periodic(HoldoutConfig):
    """GPS is withheld for off_s of every period_s."""

    def __str__(self) -> str:
        return f"{self.off_s:g}/{self.period_s:g}"


Pattern = Outage | Periodic | None  # None withholds nothing
WITHHOLD: tuple[Pattern, ...] = (None, Periodic(10.0, 1.0), Periodic(30.0, 10.0), Periodic(60.0, 30.0))


def parse_pattern(kind: str, first_s: float, second_s: float) -> Pattern:
    """What `--withhold` means: `/` off and period, `,` start and length."""
    if kind == "/":
        return Periodic(period_s=second_s, off_s=first_s)
    return Outage(first_s, second_s) if kind == "," else None
