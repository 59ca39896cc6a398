"""The report of the demo: what became of the samples, and how far the map is from the truth."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from evaluation.audit import AuditResult
from evaluation.maps.score import DrivenScore, MapScore
from sitegrid.demo.plan import DemoPlan


def make_report(
    plan: DemoPlan,
    audit: AuditResult,
    scores: tuple[MapScore, DrivenScore],
    rmse_m: dict[str, float],
    pictures: list[str],
    log: dict[str, Any] | None,
) -> dict[str, Any]:
    """The report as a table. rmse_m: position error of each machine. log: the report of the replayed log."""
    whole, driven = scores
    log_lost, log_double = (log["lost"], log["double"]) if log else (0, 0)
    return {
        "machines": len(plan.configs),
        "seconds": plan.scenario.seconds,
        "seed": plan.scenario.seed,
        "samples_recorded": audit.recorded,
        "samples_merged": audit.merged,
        "lost": audit.lost + log_lost,
        "double": audit.double + log_double,
        "unrecorded": audit.unrecorded,
        "cells": whole.cells,
        "wrong_resistance_pct": round(whole.wrong_resistance_pct, 2),
        "wrong_grade_pct": round(whole.wrong_grade_pct, 2),
        "driven": {name: round(v, 2) if isinstance(v, float) else v for name, v in asdict(driven).items()},
        "position_rmse_m": {name: round(value, 2) for name, value in rmse_m.items()},
        "pictures": [*pictures, *([log["picture"]] if log else [])],
        "log": log,
    }


def print_report(result: dict[str, Any]) -> None:
    """The report for people."""
    r, driven = result, result["driven"]
    rmse = ", ".join(f"{name} {value} m" for name, value in r["position_rmse_m"].items())
    print(
        f"{r['machines']} machines drove {r['seconds']:g} s, recorded {r['samples_recorded']} samples;\n"
        f"  merged {r['samples_merged']}, lost {r['lost']}, double {r['double']}\n"
        f"  {r['cells']} cells are known: resistance class wrong in {r['wrong_resistance_pct']} %, "
        f"slope class in {r['wrong_grade_pct']} %\n"
        f"  {driven['cells']} cells were truly driven: {driven['known_pct']} % are known, of these "
        f"{driven['wrong_resistance_pct']} % wrong by resistance, {driven['wrong_grade_pct']} % by slope\n"
        f"  position error (rms): {rmse}"
    )
    if log := result["log"]:
        withheld = f"{log['withheld_rms_m']} m rms against {log['withheld_fixes']} withheld fixes"
        print(f"real log {log['name']}: {log['recorded']} samples, lost {log['lost']}, {withheld}")
    print("pictures:", *result["pictures"], sep="\n  ")
