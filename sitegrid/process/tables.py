"""Reports as text: values on lines of their own, rows as tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

Report = dict[str, Any]
MOST_COLUMNS = 24  # of a table; one with more is turned, its rows side by side
SHOWN = (list, dict)  # values of a row that a table for people has no room for


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Rows under their names, numbers to the right; what is not known is a dash."""
    lines = [list(rows[0]), *(["-" if value is None else str(value) for value in row.values()] for row in rows)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join("  ".join(w.rjust(width) for w, width in zip(line, widths, strict=True)) for line in lines)


def lines(report: Report) -> list[str]:
    """For people: values on a line of their own, rows as tables."""
    shown_lines = []
    for name, value in report.items():
        if isinstance(value, list) and value and isinstance(value[0], dict):
            shown = [k for k in value[0] if not any(isinstance(row[k], SHOWN) for row in value)]
            rows = [{k: row[k] for k in shown} for row in value]
            shown_lines.append(table(_turned(rows) if len(rows[0]) > MOST_COLUMNS else rows))
        elif value not in ([], {}):
            shown_lines.append(f"{name}: {value}")
    return shown_lines


def _turned(rows: Sequence[Report]) -> list[Report]:
    """Rows as columns, under their first values."""
    named = {f"{next(iter(row.values()))} {list(row.values())[1]}": row for row in rows}
    return [{"": name, **{title: row[name] for title, row in named.items()}} for name in list(rows[0])[2:]]
