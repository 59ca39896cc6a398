"""What the estimators of the rolling resistance have in common: their input, and their methods."""

from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True, slots=True)
class BalanceStep:
    """One usable step of the force balance: raw = direction cos(slope) c_rr + scale error * share.

    stamp_ns: of its end; dt_s; distance_m: driven since the last usable step. raw: with the calibration applied [-].
    regressor: direction cos(slope) [-]. share: drive force over weight, signed ahead [-]. lead_share: share of the load
    that the leading axle carries; wheelbase_m: how far the trailing axle is behind it; lead_m: how far the load centre
    is. Without a wheelbase, all wheels stand on the same ground.
    """

    stamp_ns: int
    dt_s: float
    distance_m: float
    raw: float
    regressor: float
    share: float
    lead_share: float = 1.0
    wheelbase_m: float = 0.0
    lead_m: float = 0.0


class ResistanceEstimator(Protocol):
    """An estimator of c_rr."""

    def update(self, step: BalanceStep) -> None:
        """Add a step."""
        ...

    def stand(self, *, changes_load: bool) -> None:
        """The machine stands; changes_load: it may carry another load when it drives on."""
        ...

    def at(self, stamp_ns: int) -> tuple[float, float] | None:
        """c_rr and its variance [-] of the ground at a recent stamp; None if no step was usable around it."""
        ...
