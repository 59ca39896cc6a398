"""Tables of result pages, made from the printed reports beside them: nobody types a figure.

    sitegrid eval roads --seeds 8 --first-seed 1000 --json > docs/results/roads.json
    python -m evaluation.campaign.pages docs/results/roads.md

A page says where a table belongs: `<!-- table: roads.json goals -->`, and behind the table `<!-- end -->`. Tables are
`goals` (of all rows), and the names of rows: all figures of one, seed by seed.
"""

from __future__ import annotations

import json
import math
import re
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from evaluation.campaign.figures import Report, Row, select
from protocol.errors import ConfigError

_BLOCK = re.compile(r"(<!-- table: (\S+) (\S+) -->\n)(.*?)(<!-- end -->)", re.DOTALL)
NOT_MEASURED = "Not measured yet.\n"
GOALS = "goals"
NAME = "case"  # of a row
_NO_FIGURES = (NAME, "by_seed")


def filled(text: str, folder: Path) -> str:
    """A page with its tables as the reports in a folder have them. ConfigError for a table that its report has not."""

    def table(block: re.Match[str]) -> str:
        begin, file, name, _, end = block.groups()
        path = folder / file
        content = _table(json.loads(path.read_text()), name, path) if path.exists() else NOT_MEASURED
        return f"{begin}{content}{end}"

    return _BLOCK.sub(table, text)


def _table(report: Report, name: str, path: Path) -> str:
    rows = [*report["rows"], *report.get("ways", [])]
    if name == GOALS:
        return goals_table(report["goals"], rows, report["seeds"])
    if own := select(rows, {NAME: name}):
        return figures_table(own[0], report["seeds"])
    known = ", ".join([GOALS, *(row[NAME] for row in rows)])
    raise ConfigError(str(path), f"has no table `{name}`; known: {known}")


def goals_table(goals: Iterable[Row], rows: Sequence[Row], seeds: Sequence[int]) -> str:
    """Each goal with what was measured, in bold where it was missed, and what each seed gave."""
    lines = []
    for goal in goals:
        value = text_of(goal["value"])
        (row,) = select(rows, {NAME: goal["row"]})
        each = [own.get(goal["name"]) for own in row.get("by_seed", [])]
        by_seed = ", ".join(map(text_of, each)) if any(one is not None for one in each) else ""
        lines.append(
            [goal["row"], f"`{goal['name']}`", goal["goal"], value if goal["met"] else f"**{value}**", by_seed]
        )
    return markdown(["row", "figure", "goal", "measured", f"seeds {', '.join(map(str, seeds))}"], lines)


def figures_table(row: Row, seeds: Sequence[int]) -> str:
    """All figures of a row, and what each seed gave."""
    each = row.get("by_seed", [])
    names = dict.fromkeys([*row, *(name for own in each for name in own)])
    lines = [
        [f"`{name}`", text_of(row.get(name)), *(text_of(own.get(name)) for own in each)]
        for name in names
        if name not in _NO_FIGURES
    ]
    return markdown([row[NAME], "all", *(map(str, seeds) if each else ())], lines)


def markdown(head: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    """A table of Markdown, with its last line break."""
    rows = [head, ["---"] * len(head), *lines]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in rows)


def text_of(value: Any) -> str:
    """A figure as pages have it: whole numbers without a point, at most five digits; nothing for none."""
    if not isinstance(value, int | float) or not math.isfinite(value):
        return value if isinstance(value, str) else ""
    return f"{value:.5g}" if isinstance(value, float) and abs(value) < 1e5 else f"{value:.0f}"


def main(paths: Sequence[str]) -> int:
    """Fill pages; says which ones are others now."""
    for path in map(Path, paths):
        before = path.read_text()
        after = filled(before, path.parent)
        if after != before:
            path.write_text(after)
            print(f"{path}: tables made again")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
