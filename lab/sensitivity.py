"""Sensitivity: each constant of a stage's Tuning varied alone, on the same recordings."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

from agents.estimation.tuning import TUNING as ESTIMATION
from agents.estimation.tuning import EstimationTuning
from agents.localisation.tuning import TUNING as LOCALISATION
from agents.localisation.tuning import LocalisationTuning
from lab.calibration import experiment as calibration
from lab.calibration.cases import CASES, FleetCase
from lab.campaign.experiment import Runner
from lab.campaign.recordings import PAPER
from lab.ground import experiment as ground
from lab.ground.experiment import GroundConfiguration
from lab.positions import experiment as positions
from lab.positions.configurations import Configuration
from mapserver.calibration.tuning import TUNING as CALIBRATION
from mapserver.trust.tuning import TUNING as TRUST
from sitegrid.proof.figures import Report, Row, rounded

BY = 0.3  # relative variation, both ways
Tuning = TypeVar("Tuning")
Variant = tuple[str, float]  # constant, factor
FAST = replace(PAPER, world="fast")  # cheap drives with sensor errors of the usual kind
AS_IT_IS: Variant = ("", 1.0)


@dataclass(frozen=True)
class Stage:
    """What is varied and judged.

    rows: a row of figures per variant. intervals: half-widths of published 95 % intervals over seeds; for normalised
    errors their own resolution.
    """

    tuning: Any
    rows: Callable[[Runner, Sequence[int], float, Sequence[Variant]], Sequence[Row]]
    intervals: Mapping[str, float]


@dataclass(frozen=True, kw_only=True)
class VariedGround(GroundConfiguration):
    """The published ground row with one constant varied."""

    variant: Variant = AS_IT_IS

    @property
    def name(self) -> str:
        """Short unique name."""
        return f"{super().name}-{self.variant[0]}-{self.variant[1]:g}"

    @property
    def tuning(self) -> EstimationTuning:
        """Tuning with the constant varied."""
        return varied(ESTIMATION, self.variant)


@dataclass(frozen=True, kw_only=True)
class VariedPositions(Configuration):
    """A published positions row with one constant varied."""

    variant: Variant = AS_IT_IS

    @property
    def name(self) -> str:
        """Short unique name."""
        return f"{super().name}-{self.variant[0]}-{self.variant[1]:g}"

    @property
    def tuning(self) -> LocalisationTuning:
        """Tuning with the constant varied."""
        return varied(LOCALISATION, self.variant)


def varied(tuning: Tuning, variant: Variant) -> Tuning:
    """A Tuning with one constant varied; integers stay integers."""
    constant, factor = variant
    if not constant:
        return tuning
    value = getattr(tuning, constant)
    changes: dict[str, Any] = {constant: round(value * factor) if isinstance(value, int) else value * factor}
    return replace(tuning, **changes)  # type: ignore[type-var]


def variants(tuning: object) -> list[Variant]:
    """Every constant both ways."""
    names = [field.name for field in fields(tuning)]  # type: ignore[arg-type]
    return [(name, factor) for name in names for factor in (1 - BY, 1 + BY)]


def run(runner: Runner, seeds: Sequence[int], seconds: float, stage: str = "estimation") -> tuple[Report, None]:
    """Vary all constants of a stage; a row per constant: shifts of figures, and those beyond intervals."""
    chosen = STAGES[stage]
    whole, *others = chosen.rows(runner, seeds, seconds, [AS_IT_IS, *variants(chosen.tuning)])
    names = [field.name for field in fields(chosen.tuning)]
    triples = zip(names, others[::2], others[1::2], strict=True)
    rows = [moved(chosen, name, whole, (less, more)) for name, less, more in triples]
    as_it_is = {name: whole[name] for name in chosen.intervals}
    return {"stage": stage, "seeds": list(seeds), "seconds": seconds, "as_it_is": as_it_is, "rows": rows}, None


def moved(stage: Stage, constant: str, whole: Row, both: tuple[Row, Row]) -> Row:
    """Shifts of figures by a constant's two variants."""
    by = {name: [row[name] - whole[name] for row in both] for name in stage.intervals}
    beyond = [name for name, steps in by.items() if not max(map(abs, steps)) <= stage.intervals[name]]
    value = getattr(stage.tuning, constant)
    return {"constant": constant, "value": value, **rounded(by, 4), "moves": " ".join(beyond)}


def _ground(runner: Runner, seeds: Sequence[int], seconds: float, some: Sequence[Variant]) -> Sequence[Row]:
    varied_rows = [VariedGround("kalman", "calibrated", variant=variant) for variant in some]
    rows: list[Row] = ground.run(runner, seeds, seconds, varied_rows)[0]["rows"]
    return rows


def _positions(runner: Runner, seeds: Sequence[int], seconds: float, some: Sequence[Variant]) -> Sequence[Row]:
    varied_rows = [VariedPositions("ukf", 2, 1, "default", variant=variant) for variant in some]
    rows: list[Row] = positions.run(runner, seeds, seconds, varied_rows, FAST)[0]["rows"]
    return rows


def _calibration(runner: Runner, seeds: Sequence[int], seconds: float, some: Sequence[Variant]) -> Sequence[Row]:
    """Map after calibration of three machines; samples are made once."""
    reports = [calibration.run(runner, seeds, seconds, _cases("machines_3"), varied(CALIBRATION, v))[0] for v in some]
    return [row for report in reports for row in report["rows"] if row["map"] == "after"]


def _trust(runner: Runner, seeds: Sequence[int], seconds: float, some: Sequence[Variant]) -> Sequence[Row]:
    """Excluded machines: of four sound ones, with one bad, with one gain."""
    cases = _cases(*EXCLUDED)
    runs = [calibration.run(runner, seeds, seconds, cases, trust=varied(TRUST, variant))[1] for variant in some]
    return [{case.name: sum(len(one.distrusted) for one in by_case[case]) for case in cases} for by_case in runs]


def _cases(*names: str) -> list[FleetCase]:
    return [case for case in CASES if case.name in names]


EXCLUDED = ("machines_4", "bad_machine", "gain_1.6")
STAGES = {
    "estimation": Stage(
        ESTIMATION,
        _ground,
        {
            "right_class_pct": 0.5,
            "wrong_cells_pct": 0.6,
            "grade_bias_deg": 0.02,
            "grade_std_deg": 0.02,
            "normalised_error": 0.05,
        },
    ),
    "localisation": Stage(
        LOCALISATION, _positions, {"net_m": 0.13, "smoothed_net_m": 0.13, "coverage95": 0.02, "smoothed_nees": 0.4}
    ),
    "calibration": Stage(
        CALIBRATION, _calibration, {"wrong_pct": 0.3, "rms_zero": 1e-4, "rms_scale": 0.003, "normalised": 0.1}
    ),
    "trust": Stage(TRUST, _trust, dict.fromkeys(EXCLUDED, 0.5)),
}
