"""What estimators of the rolling resistance share: what they are given, and what they say."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True, slots=True)
class Push:
    """One usable step: raw = direction cos(slope) c_rr + scale error * share, by the balance of forces.

    stamp_ns: of its end; dt_s; way_m: driven since the last step that was usable. raw: with the calibration taken off
    [-]. regressor: direction cos(slope) [-]. share: drive force over weight, signed ahead [-]. lead_share: of the load,
    that the leading axle bears; wheelbase_m: how far the trailing one is behind it, lead_m: the load centre. Without a
    wheelbase, all wheels stand on the same ground.
    """

    stamp_ns: int
    dt_s: float
    way_m: float
    raw: float
    regressor: float
    share: float
    lead_share: float = 1.0
    wheelbase_m: float = 0.0
    lead_m: float = 0.0


class Resistance(Protocol):
    """An estimator of c_rr."""

    def update(self, push: Push) -> None:
        """Take in a step."""
        ...

    def rest(self, *, changes_load: bool) -> None:
        """The machine stands; changes_load: what it carries may be another when it drives on."""
        ...

    def at(self, stamp_ns: int) -> tuple[float, float] | None:
        """c_rr and its variance [-] of the ground at a recent stamp; None if no step was usable around it."""
        ...
