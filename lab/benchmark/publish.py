"""Publish the hashes of recordings that were made, for others to compare theirs with.

`python -m lab bench make --json > made.json`, then `python -m lab.benchmark.publish made.json`.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from lab.benchmark.recordings import HASHES, PARTS, published_hashes
from protocol.files import write_whole
from sitegrid.proof.figures import Report


def with_hashes(published: Mapping[str, Mapping[str, Mapping[str, str]]], made: Report) -> Report:
    """The published hashes with those of a report of `python -m lab bench make` in place of its edition's."""
    return {**published, made["edition"]: {row["name"]: {part: row[part] for part in PARTS} for row in made["rows"]}}


def main(paths: Sequence[str]) -> int:
    """Publish the hashes of reports."""
    for path in map(Path, paths):
        table = with_hashes(published_hashes(), json.loads(path.read_text(encoding="utf-8")))
        write_whole(HASHES, f"{json.dumps(table, indent=1)}\n".encode())
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
