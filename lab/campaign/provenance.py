"""Provenance of a report: command, commit, date.

Results are cached by what they depend on, so the printing code would reproduce any report.
"""

from __future__ import annotations

import resource
import shlex
import subprocess
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path

from lab.campaign.code import ROOT
from protocol.version import package_version
from sitegrid.proof.figures import Row

# Options that change no figure, or name local paths.
WITHOUT = ("--data", "--out", "--plots", "--processes", "--tensor")


def made_by(words: Sequence[str]) -> Row:
    """`command`, `commit`, `date` of printing and `processor_min` of a report; words: after `python -m lab`.

    Minutes of this process and its workers, without cached results.
    """
    command = shlex.join(["python", "-m", "lab", *_lasting(words)])
    used = [resource.getrusage(whose) for whose in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    minutes = sum(each.ru_utime + each.ru_stime for each in used) / 60
    today = datetime.now(UTC).date().isoformat()
    return {"command": command, "commit": commit_of(ROOT), "date": today, "processor_min": round(minutes, 1)}


def commit_of(folder: Path) -> str:
    """A checkout's commit, `-dirty` if modified; the version without a checkout."""
    words = ["git", "-C", str(folder), "describe", "--always", "--exclude=*", "--abbrev=8", "--dirty"]
    try:
        return subprocess.run(words, capture_output=True, check=True, text=True).stdout.strip()  # noqa: S603
    except (OSError, subprocess.CalledProcessError):
        return package_version()


def _lasting(words: Sequence[str]) -> Iterator[str]:
    """Words without local options; absolute paths reduced to their names."""
    left = iter(words)
    for word in left:
        if word in WITHOUT:
            next(left, None)
        elif not word.startswith(tuple(f"{name}=" for name in WITHOUT)):
            yield Path(word).name if word.startswith("/") else word
