"""`sitegrid eval`: the experiments behind the project's figures."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Sequence
from typing import Any

from evaluation import physics
from sitegrid.process import note, plain, say


def run(arguments: Namespace) -> int:
    """Run one evaluation and print what it found."""
    seeds = range(arguments.first_seed, arguments.first_seed + arguments.seeds)
    result = physics.run(seeds, on_progress=lambda what: note(what))
    if arguments.json:
        say(plain(result))
    else:
        for rows in result.values():
            print(table(rows) + "\n")
    return 0


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Rows under their names, numbers to the right."""
    lines = [list(rows[0]), *([str(value) for value in row.values()] for row in rows)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join("  ".join(w.rjust(width) for w, width in zip(line, widths, strict=True)) for line in lines)
