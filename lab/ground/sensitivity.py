"""Which constants of the ground's estimators matter: each is varied alone, on the same recordings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

from agents.estimation.tuning import TUNING, EstimationTuning
from lab.campaign.experiment import Runner
from lab.ground import experiment
from lab.ground.experiment import GroundConfiguration
from sitegrid.proof.figures import Report, Row, rounded

BY = 0.3  # of a constant, both ways
# Half-widths of the 95 % intervals of the published table over seeds; of the normalised error, what is no better known.
INTERVALS = {
    "right_class_pct": 0.5,
    "wrong_cells_pct": 0.6,
    "grade_bias_deg": 0.02,
    "grade_std_deg": 0.02,
    "normalised_error": 0.05,
}


@dataclass(frozen=True)
class VariedGround(GroundConfiguration):
    """The published row with one constant multiplied by a factor; "": none."""

    constant: str = ""
    factor: float = 1.0

    @property
    def name(self) -> str:
        """Short and unique."""
        return f"{super().name}-{self.constant}-{self.factor:g}"

    @property
    def tuning(self) -> EstimationTuning:
        """With the constant varied; a whole number stays one."""
        if not self.constant:
            return TUNING
        value = getattr(TUNING, self.constant)
        changed = value * self.factor
        changes: dict[str, Any] = {self.constant: round(changed) if isinstance(value, int) else changed}
        return replace(TUNING, **changes)


def variants() -> list[VariedGround]:
    """As it is, then each constant both ways."""
    names = [field.name for field in fields(EstimationTuning)]
    varied = [VariedGround("kalman", "calibrated", name, factor) for name in names for factor in (1 - BY, 1 + BY)]
    return [VariedGround("kalman", "calibrated"), *varied]


def run(runner: Runner, seeds: Sequence[int], seconds: float) -> tuple[Report, None]:
    """Vary all constants; a row for each, with what its figures move by, and which of them beyond their intervals."""
    report, _ = experiment.run(runner, seeds, seconds, variants())
    whole, *others = report["rows"]
    rows = [moved(whole, *pair) for pair in zip(others[::2], others[1::2], strict=True)]
    return {"seeds": list(seeds), "seconds": seconds, "as_it_is": _figures(whole), "rows": rows}, None


def moved(whole: Row, less: Row, more: Row) -> Row:
    """By how much a constant's two variants move the figures."""
    by = {name: [varied[name] - whole[name] for varied in (less, more)] for name in INTERVALS}
    beyond = [name for name, steps in by.items() if max(map(abs, steps)) > INTERVALS[name]]
    constant = less["constant"]
    return rounded({"constant": constant, "value": getattr(TUNING, constant), **by, "moves": " ".join(beyond)}, 3)


def _figures(row: Row) -> Row:
    return {name: row[name] for name in INTERVALS}
