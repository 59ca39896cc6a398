"""Days of work on 1 km2: samples of ten machines on a web of roads, and a store full of them.

Five roads each way, 10 m wide, 1 km long: a tenth of the site. At crossings machines turn or go on, never back. On a
leg a machine keeps its right-hand lane and one position error, since satellite errors last a minute.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, count, islice
from pathlib import Path

import numpy as np

from mapserver.config import ServerConfig
from mapserver.evidence.grid import Grid
from mapserver.journal.facts import NO_FACTS
from mapserver.journal.location import JournalLocation
from mapserver.journal.rows import Admission
from mapserver.past.checkpoint_file import OPEN_END_NS, Checkpoint
from mapserver.past.checkpoints import save_snapshot
from mapserver.past.past import StorePast
from protocol.arrays import AnyArray, Floats, Table
from protocol.machine.samples import empty
from protocol.site.site_config import SiteConfig
from protocol.wire.messages import SampleBatch

START_NS = 1_767_225_600_000_000_000

MACHINES, ROADS = 10, 5  # roads in each direction
WIDTH_M, LEG_M = 10.0, 250.0  # of a road; between crossings
SPEED_MPS, SPACING_M = 3.0, 0.5
STD_M = 1.2  # of a position
HOURS = 10.0  # working day
BATCH = 100  # samples per batch
A_SECOND = 6  # samples per second
IN_ONE_COMMIT = 10_000  # journal rows of a store
LEG_SAMPLES = int(LEG_M / SPACING_M)
SAMPLE_NS, DAY_NS = int(SPACING_M / SPEED_MPS * 1e9), 86_400 * 10**9
# Ground: 50 m patches of one resistance each, on gentle hills.
RESISTANCES = np.array([0.015, 0.03, 0.05, 0.08])
PATCH_M, HILL_M, GRADE = 50.0, 120.0, 0.08
RESISTANCE_STD, GRADE_STD = 0.004, 0.01
Batches = Sequence[tuple[str, Table]]
HEADINGS = ((1, 0), (0, 1), (-1, 0), (0, -1))  # of roads: columns and rows of crossings per leg


@dataclass(frozen=True)
class RoadLeg:
    """A drive between crossings. first_ns: stamp of its first sample; heading: index of HEADINGS."""

    first_ns: int
    column: int
    row: int
    heading: int


def samples_of(hours: float) -> int:
    """Samples from `batches` in the first hours of work: whole legs, at least one."""
    return MACHINES * LEG_SAMPLES * max(1, round(hours * 3600 * 1e9 / (LEG_SAMPLES * SAMPLE_NS)))


def batches(seed: int = 0) -> Iterator[tuple[str, Table]]:
    """Machine names and sample batches in order of arrival, endlessly."""
    draws = np.random.default_rng(seed).spawn(MACHINES)
    drives = [drive(draw) for draw in draws]
    while True:
        driven = [next(legs) for legs in drives]
        for first in range(0, LEG_SAMPLES, BATCH):
            for number, rows in enumerate(driven, start=1):
                yield f"loader-{number}", rows[first : first + BATCH]


def seconds_of(work: Iterator[tuple[str, Table]]) -> Iterator[Batches]:
    """Machines' samples by second; work: of `batches`, all starting a leg."""
    while leg := list(islice(work, MACHINES * LEG_SAMPLES // BATCH)):
        machines = {name: np.concatenate([rows for other, rows in leg if other == name]) for name, _ in leg}
        for first in range(0, LEG_SAMPLES, A_SECOND):
            yield [(name, rows[first : first + A_SECOND]) for name, rows in machines.items()]


def drive(draw: np.random.Generator) -> Iterator[Table]:
    """Samples of one machine by leg, endlessly."""
    return (_drive(leg, draw) for leg in _legs(draw))


def _legs(draw: np.random.Generator) -> Iterator[RoadLeg]:
    """Legs of one machine, end to end, with nights between days."""
    column, row, heading = int(draw.integers(ROADS)), int(draw.integers(ROADS)), int(draw.integers(4))
    a_day = samples_of(HOURS) // (MACHINES * LEG_SAMPLES)
    for number in count():
        # a heading two further leads back
        headings = [h for h in range(4) if (h - heading) % 4 != 2 and _on_site(column, row, h)]
        heading = int(draw.choice(headings))
        day, leg = divmod(number, a_day)
        yield RoadLeg(START_NS + day * DAY_NS + leg * LEG_SAMPLES * SAMPLE_NS, column, row, heading)
        column, row = column + HEADINGS[heading][0], row + HEADINGS[heading][1]


def _on_site(column: int, row: int, heading: int) -> bool:
    return 0 <= column + HEADINGS[heading][0] < ROADS and 0 <= row + HEADINGS[heading][1] < ROADS


def _drive(leg: RoadLeg, draw: np.random.Generator) -> Table:
    n, (east, north) = LEG_SAMPLES, HEADINGS[leg.heading]
    along = np.arange(n) * SPACING_M
    right = draw.uniform(0.0, WIDTH_M / 2)
    x = leg.column * LEG_M + east * along + north * right
    y = leg.row * LEG_M + north * along - east * right
    error_x, error_y = draw.normal(0.0, STD_M, 2)
    rows = empty(n)
    rows["stamp_ns"] = leg.first_ns + np.arange(n) * SAMPLE_NS
    rows["x_m"], rows["y_m"] = x + error_x, y + error_y
    rows["cov_xx_m2"] = rows["cov_yy_m2"] = STD_M**2
    rows["heading_rad"] = np.arctan2(north, east) + draw.normal(0.0, 0.05, n)
    rows["distance_m"], rows["speed_mps"] = SPACING_M, SPEED_MPS
    rows["c_rr"] = _resistance(x, y) + draw.normal(0.0, RESISTANCE_STD, n)
    rows["grade_e"] = GRADE * np.sin(x / HILL_M) + draw.normal(0.0, GRADE_STD, n)
    rows["grade_n"] = GRADE * np.cos(y / HILL_M) + draw.normal(0.0, GRADE_STD, n)
    return rows


def _resistance(x: AnyArray, y: AnyArray) -> Floats:
    patch = (np.floor(x / PATCH_M) + 3 * np.floor(y / PATCH_M)).astype(np.int64)
    resistance: Floats = RESISTANCES[patch % len(RESISTANCES)]
    return resistance


def evidence_hash(snapshot: Path) -> str:
    """Digest of a snapshot's evidence; its header names the store, which varies."""
    with Checkpoint(snapshot) as checkpoint:
        parts = [checkpoint.index.tobytes(), *checkpoint.records(checkpoint.numbers_in(None))]
        return hashlib.sha256(b"".join(parts)).hexdigest()


def write_store(
    folder: Path, site: SiteConfig, rows: int, tail_rows: int, in_row: int = BATCH, known: Sequence[str] = ()
) -> None:
    """Write a journal of `rows`, and a snapshot tail_rows before its end, if it is longer.

    in_row: samples per row: BATCH, or A_SECOND for machines that are always connected. known: further machines, of
    which it has a sample each.
    """
    config = ServerConfig().fold
    journal, grid = JournalLocation(folder).open(site.name, site.frame), Grid(site.cell_m, config)
    work = batches() if in_row == BATCH else chain.from_iterable(seconds_of(batches()))
    sent: Counter[str] = Counter()
    journal.begin()
    for number, (name, batch) in enumerate(islice(work, rows), start=1):
        new = SampleBatch(name, 1, sent[name] + 1, batch, site.frame)
        journal.append(Admission(new, trimmed=0, lost=0), START_NS)
        sent[name] += len(batch)
        if number <= rows - tail_rows:
            grid.fold(batch, name)
        if number == rows - tail_rows:
            depends_on = StorePast.of_store(folder, site.cell_m, config).depends_on(journal, NO_FACTS)
            save_snapshot(folder, number, depends_on(OPEN_END_NS), grid.state())
        if number % IN_ONE_COMMIT == 0:
            journal.commit()
            journal.begin()
    for name in known:
        journal.append(Admission(SampleBatch(name, 2, 1, batch[:1], site.frame), trimmed=0, lost=0), START_NS)
    journal.commit()
    journal.close()
