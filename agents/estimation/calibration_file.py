"""The calibration of a machine on disk, so that a restart does not forget it."""

from __future__ import annotations

import json
import math
import os
from dataclasses import asdict
from pathlib import Path
from typing import Any

from agents.estimation.calibration import Calibration
from protocol.errors import StoreError

VERSION = 1


def save(path: Path, machine: str, calibration: Calibration) -> None:
    """Write whole or not at all; raises StoreError."""
    part = path.with_name(path.name + ".part")
    text = json.dumps({"version": VERSION, "machine": machine, **asdict(calibration)}, indent=1)
    try:
        with part.open("w", encoding="utf-8") as file:
            file.write(text + "\n")
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    except OSError as error:
        raise StoreError(path, f"cannot be written: {error.strerror}") from None


def load(path: Path, machine: str) -> Calibration | None:
    """Read what `save` wrote; None where there is no file. Raises StoreError on anything else than a calibration."""
    try:
        kept = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, RecursionError) as error:
        raise StoreError(path, f"cannot be read: {error}") from None
    if not isinstance(kept, dict) or kept.get("version") != VERSION:
        raise StoreError(path, f"is no calibration of version {VERSION}")
    if kept.get("machine") != machine:
        raise StoreError(path, f"is the calibration of {kept.get('machine')!r}, not of {machine!r}")
    return _parse(path, kept)


def _parse(path: Path, kept: dict[str, Any]) -> Calibration:
    try:
        (zz, zs), (sz, ss) = ((float(a), float(b)) for a, b in kept["covariance"])
        zero, scale = float(kept["zero"]), float(kept["scale"])
        stamp_ns, passages = int(kept["stamp_ns"]), int(kept["passages"])
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise StoreError(path, f"is no calibration: {error}") from None
    sound = math.isfinite(zero + scale + zz + zs + ss) and zz > 0 and ss > 0 and zs * zs <= zz * ss and zs == sz
    if not (sound and abs(zero) < 1 and abs(scale) < 1 and stamp_ns >= 0 and passages >= 0):
        raise StoreError(path, "is no calibration: its numbers make no sense")
    return Calibration(zero, scale, ((zz, zs), (sz, ss)), stamp_ns, passages)
