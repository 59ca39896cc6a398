"""An agent's health in words; agents of other versions may send any values."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

MOST_PROBLEMS, MOST_SENSORS, MOST_CHARS = 10, 20, 300  # display limits per machine


def status_of(values: Mapping[str, Any]) -> str:
    """The agent's sentence about itself, or empty."""
    status = values.get("status")
    return one_line(status) if isinstance(status, str) else ""


def problems_of(values: Mapping[str, Any]) -> list[str]:
    """Problems to mend, a sentence each, worst first."""
    problems = values.get("problems")
    return [one_line(str(problem)) for problem in problems[:MOST_PROBLEMS]] if isinstance(problems, list) else []


def table_of(values: Mapping[str, Any], *names: str) -> Mapping[str, Any]:
    """A nested table, empty if missing."""
    for name in names:
        table = values.get(name)
        values = table if isinstance(table, Mapping) else {}
    return values


def number_of(values: Mapping[str, Any], name: str) -> float | None:
    """A finite number, or None."""
    value = values.get(name)
    is_number = isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e18
    return value if is_number else None


def report_of(values: Mapping[str, Any]) -> dict[str, Any]:
    """Page values of an agent besides its problems; None: not stated."""
    pipeline, spool, corrections, lanes = (table_of(values, n) for n in ("pipeline", "spool", "corrections", "lanes"))
    heard = values.get("heard")
    return {
        "status": status_of(values),
        "position_std_m": number_of(pipeline, "position_std_m"),
        "speed_mps": number_of(pipeline, "speed_mps"),
        "samples": number_of(values, "samples"),
        "acknowledged": number_of(values, "acknowledged"),
        "waiting": number_of(spool, "depth"),
        "silent_s": number_of(values, "silent_s"),
        "heard": [one_line(str(name)) for name in heard[:MOST_SENSORS]] if isinstance(heard, list) else [],
        "base": one_line(str(corrections["base"])) if "base" in corrections else None,
        "corrections_age_s": number_of(corrections, "age_s"),
        "lanes": one_line(str(lanes["sentence"])) if "sentence" in lanes else None,
        "calibration_std": number_of(table_of(pipeline, "ground", "calibration"), "zero_std"),
    }


def line_of(machine: str, report: Mapping[str, Any]) -> str:
    """One line for people: position uncertainty, speed, samples, status."""
    pipeline = report["pipeline"]
    std_m, speed_mps = pipeline["position_std_m"], pipeline["speed_mps"]
    parts = [machine, "no place" if std_m is None else f"+-{std_m:.2f} m  {abs(speed_mps):.1f} m/s"]
    if report["samples"]:
        parts.append(f"{report['samples']} samples, {report['acknowledged']} delivered")
    return "  ".join([*parts, report["status"]])


def summary_of(machine: str, report: Mapping[str, Any]) -> str:
    """The end of an agent's run in sentences: read, made, waiting, and why."""
    samples, waiting = report["samples"], report["spool"]["depth"] + report["spool"]["unsaved"]
    made = _counted(samples, "sample") if samples else "no samples"
    said = [f"{machine}: {_counted(report['readings'], 'reading')}, {made}"]
    if waiting:
        wait, them = ("waits", "it") if waiting == 1 else ("wait", "them")
        said.append(f"{_counted(waiting, 'sample')} {wait} in the spool; the next start sends {them}")
    elif samples:
        said.append("all are at the map server")
    if not samples or waiting or report["problems"]:
        said.append(report["status"])
    if report["holdout"]:
        said.append("withheld fixes: " + ", ".join(f"{name} {value}" for name, value in report["holdout"].items()))
    return ". ".join(sentence[0].upper() + sentence[1:] if i else sentence for i, sentence in enumerate(said)) + "."


def _counted(n: int, what: str) -> str:
    return f"{n} {what}" + ("" if n == 1 else "s")


def one_line(text: str) -> str:
    """Foreign text on one line, truncated."""
    line = " ".join("".join(c if c.isprintable() else " " for c in text[: 4 * MOST_CHARS]).split())
    return line if len(line) <= MOST_CHARS else f"{line[: MOST_CHARS - 1]}…"
