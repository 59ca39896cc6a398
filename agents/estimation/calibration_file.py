"""A machine's calibration on disk, across restarts."""

import json
import math
import zlib
from dataclasses import asdict
from pathlib import Path
from typing import Any

from agents.estimation.calibration import MOST_SCALE, MOST_ZERO, Calibration
from protocol.errors import StoreError
from protocol.files import PRIVATE, write_whole

VERSION = 3


class CalibrationFile:
    """An agent's calibration; without a path it is not kept. problem: last read or write error, or ""."""

    def __init__(self, path: Path | None, machine: str) -> None:
        self.problem = ""
        self._path, self._machine = path, machine
        self._saved_ns = 0

    def read(self) -> Calibration | None:
        """The stored calibration; an unreadable one is a problem, and the agent starts uncalibrated."""
        try:
            calibration = load(self._path, self._machine) if self._path else None
        except StoreError as error:
            self.problem = str(error)
            return None
        self._saved_ns = calibration.stamp_ns if calibration else 0
        return calibration

    def write(self, calibration: Calibration) -> None:
        """Save a newer calibration; a full disk must not stop the machine."""
        if not self._path or calibration.stamp_ns <= self._saved_ns:
            return
        try:
            save(self._path, self._machine, calibration)
        except StoreError as error:
            self.problem = str(error)
        else:
            self._saved_ns, self.problem = calibration.stamp_ns, ""


def save(path: Path, machine: str, calibration: Calibration) -> None:
    """Write atomically; StoreError."""
    table = {"version": VERSION, "machine": machine, **asdict(calibration)}
    text = json.dumps({**table, "crc32": _checksum(table)}, indent=1)
    try:
        write_whole(path, f"{text}\n".encode(), PRIVATE)
    except OSError as error:
        raise StoreError(path, f"cannot be written: {error.strerror}") from None


def load(path: Path, machine: str) -> Calibration | None:
    """Read what `save` wrote; None without a file. StoreError if it is no calibration."""
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, RecursionError) as error:
        raise StoreError(path, f"cannot be read: {error}") from None
    if not isinstance(table, dict) or table.pop("crc32", None) != _checksum(table):
        raise StoreError(path, "is damaged: its checksum is another; it is replaced by the next calibration")
    if table.get("version") != VERSION:
        raise StoreError(path, f"is no calibration of version {VERSION}")
    if table.get("machine") != machine:
        raise StoreError(path, f"is the calibration of {table.get('machine')!r}, not of {machine!r}")
    return _parse(path, table)


def _checksum(table: dict[str, Any]) -> int:
    return zlib.crc32(json.dumps(table, sort_keys=True).encode())


def _parse(path: Path, table: dict[str, Any]) -> Calibration:
    try:
        (zz, zs), (sz, ss) = ((float(a), float(b)) for a, b in table["covariance"])
        zero, scale = float(table["zero"]), float(table["scale"])
        stamp_ns, passages, offer_ns = (int(table[name]) for name in ("stamp_ns", "passages", "offer_ns"))
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise StoreError(path, f"is no calibration: {error}") from None
    sound = math.isfinite(zero + scale + zz + zs + ss) and zz > 0 and ss > 0 and zs * zs <= zz * ss and zs == sz
    if not (sound and abs(zero) <= MOST_ZERO and abs(scale) <= MOST_SCALE and min(stamp_ns, passages, offer_ns) >= 0):
        raise StoreError(path, "is no calibration: its numbers make no sense")
    return Calibration(zero, scale, ((zz, zs), (sz, ss)), stamp_ns, passages, offer_ns)
