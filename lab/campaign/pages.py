"""Fill tables of result pages from the printed reports beside them; no figure is typed.

    python -m lab roads --seeds 8 --first-seed 1000 --json > lab/results/roads.json
    python -m lab.campaign.pages lab/results/roads.md

A page marks each table's place, report and kind; `<!-- end -->` closes it:

    <!-- table: roads.json made -->          command, commit, date, seeds and processor time
    <!-- table: roads.json goals -->         all goals, missed ones in bold
    <!-- table: paper.json forecasts -->     a list of rows, with all columns of plain values
    <!-- table: paper.json rows table=maps machines=1: filter gps net_m paper.net_m -->

The last one selects rows by values (`-`: none) and columns; a dot descends into a value. Half-widths in a row's `ci95`
are shown.
"""

from __future__ import annotations

import json
import math
import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from lab.campaign.figures import select
from protocol.errors import ConfigError
from sitegrid.proof.figures import Report, Row

_BLOCK = re.compile(r"(<!-- table: (\S+) (.+?) -->\n)(.*?)(<!-- end -->)", re.DOTALL)
NOT_MEASURED = "Not measured yet.\n"
MADE, GOALS = "made", "goals"
NAME = "case"  # of a row
_NESTED = (list, dict)


def filled(text: str, folder: Path) -> str:
    """Fill a page's tables from a folder of reports. ConfigError if a report lacks one."""

    def table(block: re.Match[str]) -> str:
        begin, file, what, _, end = block.groups()
        path = folder / file
        content = _table(json.loads(path.read_text(encoding="utf-8")), what, path) if path.exists() else NOT_MEASURED
        return f"{begin}{content}{end}"

    return _BLOCK.sub(table, text)


def _table(report: Report, what: str, path: Path) -> str:
    chosen, _, columns = what.partition(":")
    name, *values = chosen.split()
    if name == MADE and MADE in report:
        return made_table(report)
    if name == GOALS:
        return goals_table(report)
    lists = {key: rows for key, rows in report.items() if isinstance(rows, list) and rows and isinstance(rows[0], dict)}
    if name in lists:
        return rows_table(_matching(lists[name], values, path), columns.split(), path)
    known = ", ".join(dict.fromkeys([MADE, GOALS, *lists]))
    raise ConfigError(str(path), f"has no table `{name}`; known: {known}")


def _cases(report: Report) -> list[Row]:
    return [row for row in (*report["rows"], *report.get("ways", [])) if NAME in row]


def made_table(report: Report) -> str:
    """Provenance of a report."""
    seeds, made = report.get("seeds", []), report[MADE]
    line = [f"`{made['command']}`", made["commit"], made["date"], _span(seeds), text_of(made["processor_min"])]
    return markdown(["command", "commit", "date", "seeds", "minutes of processor time, of what was not kept"], [line])


def _span(seeds: Sequence[int]) -> str:
    """Seeds, abbreviated if consecutive."""
    follow = len(seeds) > 2 and list(seeds) == list(range(seeds[0], seeds[0] + len(seeds)))
    return f"{seeds[0]} to {seeds[-1]}" if follow else ", ".join(map(str, seeds))


def goals_table(report: Report) -> str:
    """Goals with measurements, missed ones in bold, and values by seed if rows have them."""
    lines = []
    for goal in report[GOALS]:
        value = text_of(goal["value"]) or "not known"
        rows = select(_cases(report), {NAME: goal["row"]})
        each = [own.get(goal["name"]) for row in rows for own in row.get("by_seed", [])]
        by_seed = ", ".join(map(text_of, each)) if any(one is not None for one in each) else ""
        lines.append(
            [goal["row"], f"`{goal['name']}`", goal["goal"], value if goal["met"] else f"**{value}**", by_seed]
        )
    head = ["row", "figure", "goal", "measured", f"seeds {', '.join(map(str, report.get('seeds', [])))}"]
    columns = len(head) if any(line[-1] for line in lines) else len(head) - 1
    return markdown(head[:columns], [line[:columns] for line in lines])


def rows_table(rows: Sequence[Row], columns: Sequence[str], path: Path) -> str:
    """Rows with these columns, or all columns of plain values."""
    names = columns or [name for name in rows[0] if not any(isinstance(row.get(name), _NESTED) for row in rows)]
    lines = [[_cell(row, name, path) for name in names] for row in rows]
    return markdown([f"`{name}`" for name in names], lines)


def _matching(rows: Sequence[Row], values: Iterable[str], path: Path) -> list[Row]:
    """Rows that match all NAME=VALUE; ConfigError if none does."""
    wanted = [value.partition("=") for value in values]
    chosen = [row for row in rows if all(_named(row.get(name)) == value for name, _, value in wanted)]
    if not chosen:
        raise ConfigError(str(path), f"has no row with {' '.join(values)}")
    return chosen


def _cell(row: Row, name: str, path: Path) -> str:
    """A value with its interval's half-width; a dot descends. ConfigError for a missing column."""
    value: Any = row
    for part in name.split("."):
        if isinstance(value, Mapping) and part not in value:
            raise ConfigError(str(path), f"has rows without the column `{name}`")
        value = value[part] if isinstance(value, Mapping) else None
    text, halves = text_of(value), row.get("ci95")
    half = text_of(halves.get(name)) if isinstance(halves, Mapping) else ""
    return f"{text} +- {half}" if text and half else text


def _named(value: Any) -> str:
    return "-" if value is None else str(value)


def markdown(head: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    """A Markdown table with final newline."""
    rows = [head, ["---"] * len(head), *lines]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in rows)


def text_of(value: Any) -> str:
    """A figure for pages: integers without point, at most five digits, empty for none."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if not isinstance(value, int | float) or not math.isfinite(value):
        return value if isinstance(value, str) else ""
    return f"{value:.5g}" if isinstance(value, float) and abs(value) < 1e5 else f"{value:.0f}"


def main(paths: Sequence[str]) -> int:
    """Fill pages and report changed ones."""
    for path in map(Path, paths):
        before = path.read_text(encoding="utf-8")
        after = filled(before, path.parent)
        if after != before:
            path.write_text(after, encoding="utf-8")
            print(f"{path}: tables made again")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
