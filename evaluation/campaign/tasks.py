"""Tasks on recordings, worked off on all cores: each result lies in a file named by all that it depends on.

So an interrupted run goes on where it was, and other code or options never meet old results.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Protocol, TypeVar

from evaluation.campaign.recordings import Drive, Recording, load, make
from evaluation.campaign.workers import each
from protocol.errors import SitegridError

Progress = Callable[[float, float, str], None]  # simulated seconds done, all of them, what was done last


class Named(Protocol):
    """A row of a table."""

    @property
    def name(self) -> str:
        """Short and unique."""
        ...


class Task(Protocol):
    """One row on one recording. cache: folder of the recordings."""

    @property
    def drive(self) -> Drive:
        """What is recorded."""
        ...

    @property
    def row(self) -> Named:
        """What is run on it."""
        ...

    @property
    def cache(self) -> Path:
        """Where recordings lie."""
        ...


Job = TypeVar("Job", bound=Task)


def carry_out(
    tasks: Sequence[Job],
    result_file: Callable[[Job], Path],
    work: Callable[[tuple[Job, Path]], None],
    processes: int,
    on_progress: Progress,
) -> None:
    """Record what is not recorded, and work on the tasks whose result is not there; `work` writes it, whole."""
    waiting = [task for task in tasks if not result_file(task).exists()]
    recordings = dict.fromkeys((task.drive, task.cache) for task in waiting)
    missing = [(drive, cache) for drive, cache in recordings if not drive.folder(cache).exists()]
    total_s = sum(drive.seconds for drive, _ in missing) + sum(task.drive.seconds for task in tasks)
    done_s = sum(task.drive.seconds for task in tasks) - sum(task.drive.seconds for task in waiting)
    for (drive, _), _ in each(_record, missing, processes):
        done_s += drive.seconds
        on_progress(done_s, total_s, f"recorded seed {drive.seed} {drive.preset}")
    for (task, _), _ in each(work, [(task, result_file(task)) for task in waiting], processes):
        done_s += task.drive.seconds
        on_progress(done_s, total_s, f"seed {task.drive.seed} {task.row.name}")


def check_name(file: Path, expected: Path) -> None:
    """Raise SitegridError in a worker that read its code later than the process that named the file."""
    if file != expected:
        raise SitegridError("the sources changed during the run: start it again, it goes on where it was")


@lru_cache(maxsize=1)  # tasks come recording by recording
def loaded(drive: Drive, cache: Path) -> Recording:
    """A recording, kept in this process for the task that comes next."""
    return load(drive.folder(cache))


def _record(job: tuple[Drive, Path]) -> None:
    make(*job)
