"""What is wrong with this host's part of a site: for each topic what is looked at, and what that means.

Functions that look (`open_`, `ask_`, `read_`) change nothing; functions that judge (`check_`) are pure.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Level(StrEnum):
    """PASS: as it should be. WARN: works, not for long or not well. FAIL: does not work. SKIP: was not looked at."""

    PASS = "PASS"  # noqa: S105 - no password
    WARN = "WARN"
    FAIL = "FAIL"
    SKIP = "-"


@dataclass(frozen=True)
class Finding:
    """One line: what was checked, the result, and what to do about it."""

    level: Level
    check: str
    message: str
    advice: str = ""

    def __str__(self) -> str:
        return f"{self.level:4}  {self.check:12}  {self.message}" + (f"; {self.advice}" if self.advice else "")


def skipped(check: str, reason: str) -> Finding:
    """What was not looked at, and why."""
    return Finding(Level.SKIP, check, f"not checked: {reason}")
