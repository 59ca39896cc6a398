"""Where the figures of a report come from: the command, the commit of the code, and the date.

Results are kept by what they depend on, so whatever a report has, the code that printed it makes it.
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

# What changes no figure, and names places of one computer.
WITHOUT = ("--data", "--out", "--plots", "--processes", "--tensor")


def made_by(words: Sequence[str]) -> Row:
    """Of a report: `command`, `commit`, `date` of printing, and `processor_min`; words: what follows `python -m lab`.

    Minutes are of this process and its workers so far: of what was not kept from an earlier run.
    """
    command = shlex.join(["python", "-m", "lab", *_lasting(words)])
    used = [resource.getrusage(whose) for whose in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    minutes = sum(each.ru_utime + each.ru_stime for each in used) / 60
    today = datetime.now(UTC).date().isoformat()
    return {"command": command, "commit": commit_of(ROOT), "date": today, "processor_min": round(minutes, 1)}


def commit_of(folder: Path) -> str:
    """The commit of a checkout, with `-dirty` where files are others; the version where there is none."""
    words = ["git", "-C", str(folder), "describe", "--always", "--exclude=*", "--abbrev=8", "--dirty"]
    try:
        return subprocess.run(words, capture_output=True, check=True, text=True).stdout.strip()  # noqa: S603
    except (OSError, subprocess.CalledProcessError):
        return package_version()


def _lasting(words: Sequence[str]) -> Iterator[str]:
    """The words without those that say where; of a path from the root its last part."""
    left = iter(words)
    for word in left:
        if word in WITHOUT:
            next(left, None)
        elif not word.startswith(tuple(f"{name}=" for name in WITHOUT)):
            yield Path(word).name if word.startswith("/") else word
