"""The benchmark's recordings: simulated from seeds, with our agents' samples and published hashes."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from lab.calibration import drives
from lab.calibration.drives import Agent, FleetDrive
from lab.campaign.experiment import Runner, replay_task
from lab.campaign.recordings import Setup
from protocol.arrays import Table
from protocol.errors import ConfigError
from protocol.files import write_whole
from protocol.machine.samples import COLUMNS
from sim.scenario.file import load_scenario
from sitegrid.proof.figures import Report, Row

HASHES = Path(__file__).parent / "hashes.json"  # published hashes by recording and part
SAMPLES_FILE = "samples.csv"
MADE_FILE = "made.json"  # hashes of a recording's parts, written when complete
PARTS = ("logs", "truth", SAMPLES_FILE)
READ_BY_SCORES = PARTS[1:]
AGAIN = "delete the folder of the recording, and make it again"
MACHINE = "machine"  # first column of a samples file
NAMES = ("paper_site", "loading", "haul_road_driven")
FIRST_SEED, SEEDS = 2000, 8  # never used for development or judgement
SECONDS = 600.0
LOADERS = 4  # on the paper's site


@dataclass(frozen=True)
class BenchDrive(FleetDrive):
    """One recording, in a folder of its plain name; its hash identifies it."""

    @property
    def name(self) -> str:
        """Name for people and its folder; shorter recordings differ."""
        length = "" if self.seconds == SECONDS else f"-{self.seconds:g}s"
        return f"{self.setup.scenario}-{self.seed}{length}"

    def folder(self, cache_dir: Path) -> Path:
        """Its folder."""
        return cache_dir / self.name


@dataclass(frozen=True)
class Edition:
    """Scope of recordings: seeds per scenario, seconds each. world: overrides the scenarios'."""

    names: Sequence[str] = NAMES
    seeds: int = SEEDS
    seconds: float = SECONDS
    world: str | None = None

    @property
    def drives(self) -> list[BenchDrive]:
        """All recordings."""
        seeds = range(FIRST_SEED, FIRST_SEED + self.seeds)
        return [self._drive(name, seed) for name in self.names for seed in seeds]

    def _drive(self, name: str, seed: int) -> BenchDrive:
        preset = load_scenario(name).fleet[0].preset
        count = LOADERS if name == "paper_site" else 0
        return BenchDrive(seed, self.seconds, preset, Setup(name, (), (), (), world=self.world), count)


FULL = Edition()
QUICK = Edition(("paper_site", "loading"), seeds=1, seconds=60.0, world="fast")


def make(runner: Runner, edition: Edition) -> list[Row]:
    """Make missing recordings and samples; a row per recording with hashes and their verdict.

    published: whether all parts match the published ones; None if the edition has none. ConfigError names a recording
    that changed since it was made.
    """
    planned = edition.drives
    for drive in planned:
        if (drive.folder(runner.cache) / MADE_FILE).is_file():
            require_parts(drive.folder(runner.cache), ("logs", "truth"))
    tasks = [(drive, replay_task(agent, drive)) for drive in planned for agent in _agents(drive)]
    made = runner.run(drives.EXPERIMENT, [task for _, task in tasks])
    rows = []
    for drive in planned:
        folder = drive.folder(runner.cache)
        own = [each.samples for (other, _), each in zip(tasks, made, strict=True) if other == drive]
        write_samples(folder / SAMPLES_FILE, dict(zip(machine_names(folder), own, strict=True)))
        hashes = {part: part_hash(folder, part) for part in PARTS}
        write_whole(folder / MADE_FILE, f"{json.dumps(hashes, indent=1)}\n".encode())
        rows.append(_row(drive, hashes, edition))
    return rows


def _agents(drive: FleetDrive) -> list[Agent]:
    return [Agent(index, closed_tours=True) for index in range(drive.machines)]


def machine_names(folder: Path) -> list[str]:
    """Machines of a recording."""
    return sorted(path.name for path in (folder / "logs").iterdir() if path.is_dir())


def _row(drive: BenchDrive, hashes: Mapping[str, str], edition: Edition) -> Row:
    published = published_hashes().get(edition_key(edition), {}).get(drive.name)
    is_published = None if published is None else published == hashes
    return {
        "name": drive.name,
        "machines": drive.machines,
        "seconds": drive.seconds,
        **hashes,
        "published": is_published,
    }


def edition_key(edition: Edition) -> str:
    """Key of an edition among the published hashes."""
    return f"{edition.seconds:g} s {edition.world or 'as scenarios have it'}"


def published_hashes() -> dict[str, dict[str, dict[str, str]]]:
    """Published hashes by edition, recording and part."""
    hashes: dict[str, dict[str, dict[str, str]]] = json.loads(HASHES.read_text(encoding="utf-8"))
    return hashes


def part_hash(folder: Path, part: str) -> str:
    """SHA-256 of a part's file names and contents, independent of their order.

    Archives of arrays count by their numbers, because they contain the time.
    """
    at = folder / part
    total = hashlib.sha256()
    for path in [at] if at.is_file() else sorted(path for path in at.rglob("*") if path.is_file()):
        total.update(f"{path.relative_to(folder).as_posix()} {_content_hash(path)}\n".encode())
    return total.hexdigest()


def _content_hash(path: Path) -> str:
    """One file's hash; of an unreadable archive, its bytes."""
    if path.suffix != ".npz":
        return hashlib.sha256(path.read_bytes()).hexdigest()
    total = hashlib.sha256()
    try:
        with path.open("rb") as file, np.load(file) as arrays:
            for name in sorted(arrays):
                values = arrays[name]
                total.update(f"{name} {values.dtype.str} {values.shape}\n".encode())
                total.update(np.ascontiguousarray(values).tobytes())
    except (OSError, EOFError, ValueError, BadZipFile):
        return hashlib.sha256(path.read_bytes()).hexdigest()
    return total.hexdigest()


# --- samples files ---------------------------------------------------------------------------------------------------


def write_samples(path: Path, rows: Mapping[str, Table]) -> None:
    """Write all machines' samples as CSV, with shortest exact numbers."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([MACHINE, *COLUMNS])
    for name, table in rows.items():
        columns = [[str(value) for value in table[column]] for column in COLUMNS]
        writer.writerows([name, *values] for values in zip(*columns, strict=True))
    write_whole(path, text.getvalue().encode())


def require_made(drive: BenchDrive, cache: Path) -> None:
    """ConfigError if a recording is incomplete, or what scores read was changed."""
    folder = drive.folder(cache)
    if not (folder / MADE_FILE).is_file():
        quick = " --quick" if drive.seconds < SECONDS else ""
        raise ConfigError(
            folder,
            f"there is no such recording, or not all of it; `python -m lab bench make{quick} --data {cache}` makes it",
        )
    require_parts(folder, READ_BY_SCORES)


def require_parts(folder: Path, parts: Sequence[str]) -> None:
    """ConfigError if parts changed since they were made."""
    try:
        made = json.loads((folder / MADE_FILE).read_text(encoding="utf-8"))
        changed = [part for part in parts if made[part] != part_hash(folder, part)]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError(folder / MADE_FILE, f"cannot be read: {error}; {AGAIN}") from None
    if changed:
        raise ConfigError(folder / changed[0], f"is not what was made; {AGAIN}")


# --- published hashes ------------------------------------------------------------------------------------------------


def publish(made: Report) -> None:
    """Publish the hashes in a report of `python -m lab bench make --json` for its edition."""
    hashes = {row["name"]: {part: row[part] for part in PARTS} for row in made["rows"]}
    write_whole(HASHES, f"{json.dumps({**published_hashes(), made['edition']: hashes}, indent=1)}\n".encode())


if __name__ == "__main__":
    publish(json.loads(Path(sys.argv[1]).read_text(encoding="utf-8")))
