"""Goals as data: lab/goals.toml."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from typing import Any

from lab.campaign.code import ROOT
from lab.campaign.figures import Goal

FILE = ROOT / "lab" / "goals.toml"


def goals(rows: str) -> tuple[Goal, ...]:
    """Goals of a list of rows, by its name in the file."""
    entries = tomllib.loads(FILE.read_text(encoding="utf-8"))[rows]
    return tuple(goal for entry in entries for goal in _goals(entry.pop("row"), entry))


def _goals(row: dict[str, Any], limits: dict[str, str | list[str]]) -> Iterator[Goal]:
    for figure, texts in limits.items():
        for text in [texts] if isinstance(texts, str) else texts:
            relation, _, limit = text.partition(" ")
            assert relation in ("<=", ">="), f"{FILE}: {figure}: {text}"
            yield Goal(row, figure, "<=" if relation == "<=" else ">=", float(limit))
