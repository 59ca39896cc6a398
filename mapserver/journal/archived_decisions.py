"""Decisions about samples and roads beside archive files, so that folding these gives the server's map.

Replaced as a whole; the journal has the same decisions as events and is the truth.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from mapserver.calibration.decision import CalibrationDecision
from mapserver.journal.archive import READABLE
from mapserver.journal.places import FilePlace
from mapserver.roads.repair_facts import RoadRepair
from protocol.errors import StoreError
from protocol.files import write_whole

FILE = "decisions.json"  # file name in an archive's folder


def save(folder: Path, store: str, decisions: Iterable[CalibrationDecision | RoadRepair]) -> None:
    """Write a store's decisions, in order; raises StoreError."""
    bodies: dict[str, list[Any]] = {"calibrations": [], "repairs": []}
    for decision in decisions:
        bodies["repairs" if isinstance(decision, RoadRepair) else "calibrations"].append(decision.body())
    table = {"store": store, **bodies}
    text = json.dumps({**table, "crc32": _checksum(table)}, separators=(",", ":"))
    try:
        write_whole(folder / FILE, f"{text}\n".encode(), READABLE)
    except OSError as error:
        raise StoreError(folder / FILE, f"cannot be written: {error.strerror}") from None


def load(folder: Path | FilePlace) -> list[CalibrationDecision | RoadRepair]:
    """Read what `save` wrote, empty without a file; StoreError for damage or foreign content."""
    path = folder / FILE
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return []
    except (OSError, ValueError, RecursionError) as error:
        raise StoreError(path, f"cannot be read: {error}") from None
    if not isinstance(table, dict) or table.pop("crc32", None) != _checksum(table):
        problem = "is damaged; restore it from a backup, or remove it: the map is made without these decisions then"
        raise StoreError(path, problem)
    try:
        calibrations = map(CalibrationDecision.from_body, table["calibrations"])
        return [*calibrations, *map(RoadRepair.from_body, table["repairs"])]
    except (ValueError, TypeError, LookupError, AttributeError) as error:
        raise StoreError(path, f"{error}; remove it, if nobody has a better one") from None


def _checksum(table: dict[str, Any]) -> int:
    return zlib.crc32(json.dumps(table, sort_keys=True).encode())
