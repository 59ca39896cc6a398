"""Diagnosis of this host's part of a site.

Functions that look (`open_`, `ask_`, `read_`) change nothing; functions that judge (`check_`) are pure.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Level(StrEnum):
    """PASS: fine. WARN: works, but not for long or not well. FAIL: does not work. SKIP: not checked."""

    PASS = "PASS"  # noqa: S105 - no password
    WARN = "WARN"
    FAIL = "FAIL"
    SKIP = "-"


@dataclass(frozen=True)
class Finding:
    """Result of one check, and advice."""

    level: Level
    check: str
    message: str
    advice: str = ""

    def __str__(self) -> str:
        return f"{self.level:4}  {self.check:12}  {self.message}" + (f"; {self.advice}" if self.advice else "")


def skipped(check: str, reason: str) -> Finding:
    """A check that was not made."""
    return Finding(Level.SKIP, check, f"not checked: {reason}")
