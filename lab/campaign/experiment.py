"""Runner of all experiments: parallel tasks, each result cached in a file.

The file name digests everything the result depends on: interrupted runs resume, and results of other code or options
are never reused.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, BinaryIO, Generic, Protocol, TypeVar
from zipfile import BadZipFile

import numpy as np

from lab.campaign.code import code_version, digest
from lab.campaign.recordings import PlannedDrive, RecordedDrive, load, make
from lab.campaign.workers import each
from protocol.errors import SitegridError, StoreError
from protocol.files import whole_file

Progress = Callable[[float, float, str], None]  # simulated seconds done, total, last job


class Named(Protocol):
    """A variant under comparison."""

    @property
    def name(self) -> str:
        """Short unique name."""
        ...


Variant = TypeVar("Variant", bound=Named)
Result = TypeVar("Result")


@dataclass(frozen=True)
class Task(Generic[Variant]):
    """One variant and seed. seconds: simulated. drive: its recording, if any."""

    variant: Variant
    seed: int
    seconds: float
    drive: PlannedDrive | None = None

    @property
    def name(self) -> str:
        """Name for people and files."""
        return f"seed{self.seed}-{self.variant.name}"

    def recording(self, cache: Path) -> RecordedDrive:
        """The recording; cache: folder of recordings."""
        assert self.drive
        return load(self.drive.folder(cache))


def replay_task(variant: Variant, drive: PlannedDrive) -> Task[Variant]:
    """A task on a recording."""
    return Task(variant, drive.seed, drive.seconds, drive)


@dataclass(frozen=True)
class Experiment(Generic[Variant, Result]):
    """How tasks become results.

    name: folder of results. result: dataclass of arrays and JSON values. solve: does a task, given the folder of
    recordings; module-level, for workers. A result depends on its module, the imports, and `also`: modules run by other
    processes.
    """

    name: str
    result: type[Result]
    solve: Callable[[Task[Variant], Path], Result]
    also: tuple[str, ...] = ()

    def file(self, task: Task[Variant], cache: Path) -> Path:
        """Result file of a task."""
        recording = task.drive.folder(cache).name if task.drive else ""
        modules = self.solve.__module__, *self.also
        return cache / self.name / f"{task.name}-{digest(repr(task), recording, code_version(*modules))}.npz"


@dataclass(frozen=True)
class Runner:
    """Cache folder of recordings and results, and number of processes."""

    cache: Path
    processes: int = 1
    on_progress: Progress = lambda *_: None

    def record(self, drives: Sequence[PlannedDrive]) -> None:
        """Make missing recordings."""
        missing = [drive for drive in drives if not drive.folder(self.cache).exists()]
        self._record(missing, 0.0, sum(drive.seconds for drive in missing))

    def run(self, experiment: Experiment[Variant, Result], tasks: Sequence[Task[Variant]]) -> list[Result]:
        """Make missing recordings and results; returns all results in task order."""
        files = [experiment.file(task, self.cache) for task in tasks]
        waiting = [(task, file) for task, file in zip(tasks, files, strict=True) if not file.exists()]
        drives = dict.fromkeys(task.drive for task, _ in waiting if task.drive)
        missing = [drive for drive in drives if not drive.folder(self.cache).exists()]
        to_do_s = sum(drive.seconds for drive in missing) + sum(task.seconds for task, _ in waiting)
        total_s = sum(drive.seconds for drive in missing) + sum(task.seconds for task in tasks)
        done_s = self._record(missing, total_s - to_do_s, total_s)
        jobs = [(experiment, task, self.cache, file) for task, file in waiting]
        for (_, task, _, _), _ in each(_work, jobs, self.processes):
            done_s += task.seconds
            self.on_progress(done_s, total_s, task.name)
        return [read_result(experiment.result, file) for file in files]

    def _record(self, drives: Sequence[PlannedDrive], done_s: float, total_s: float) -> float:
        """Record drives; returns simulated seconds done."""
        for (drive, _), _ in each(_record, [(drive, self.cache) for drive in drives], self.processes):
            done_s += drive.seconds
            self.on_progress(done_s, total_s, f"recorded seed {drive.seed} {drive.preset}")
        return done_s


def write_result(result: Any, file: BinaryIO) -> None:
    """Write a dataclass: arrays as such, the rest as JSON."""
    columns = {field.name: getattr(result, field.name) for field in fields(result)}
    plain = {name: json.dumps(value) for name, value in columns.items() if not isinstance(value, np.ndarray)}
    np.savez_compressed(file, **{**columns, **plain})


def read_result(kind: type[Result], path: Path) -> Result:
    """Read what `write_result` wrote; StoreError if damaged."""
    try:
        with path.open("rb") as file, np.load(file) as columns:
            return kind(**{name: value if value.ndim else json.loads(str(value)) for name, value in columns.items()})
    except (EOFError, ValueError, TypeError, BadZipFile) as error:
        raise StoreError(path, f"is damaged ({error}); delete it, and start again") from None


# --- in the worker processes -----------------------------------------------------------------------------------------


def _record(job: tuple[PlannedDrive, Path]) -> None:
    make(*job)


def _work(job: tuple[Experiment[Variant, Result], Task[Variant], Path, Path]) -> None:
    """Do one task; SitegridError if this process has other code than the file's name."""
    experiment, task, cache, file = job
    if experiment.file(task, cache) != file:
        raise SitegridError("the sources changed during the run: start it again, it goes on where it was")
    result = experiment.solve(task, cache)
    file.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(file) as out:
        write_result(result, out)
