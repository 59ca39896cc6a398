"""Days of work on a site of 1 km2: what ten machines send that drive a web of roads all day, and a store full of it.

Five roads lead east and five north, 10 m wide and 1 km long: a tenth of the site. At each crossing a machine turns off
or goes on, never back. On the way to the next one it keeps to its lane of the right-hand half of the road, and its
position is off by one and the same error, as errors of satellite positions last for a minute.
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
WIDTH_M, LEG_M = 10.0, 250.0  # of a road; between two crossings
SPEED_MPS, SPACING_M = 3.0, 0.5
STD_M = 1.2  # of a position
HOURS = 10.0  # of a working day
BATCH = 100  # samples that a machine sends at once
A_SECOND = 6  # likewise, each second
IN_ONE_COMMIT = 10_000  # journal rows of a store
LEG_SAMPLES = int(LEG_M / SPACING_M)
SAMPLE_NS, DAY_NS = int(SPACING_M / SPEED_MPS * 1e9), 86_400 * 10**9
# Ground: patches of 50 m with one resistance each, on gentle hills.
RESISTANCES = np.array([0.015, 0.03, 0.05, 0.08])
PATCH_M, HILL_M, GRADE = 50.0, 120.0, 0.08
RESISTANCE_STD, GRADE_STD = 0.004, 0.01
Batches = Sequence[tuple[str, Table]]
HEADINGS = ((1, 0), (0, 1), (-1, 0), (0, -1))  # of the roads: columns and rows of crossings per leg


@dataclass(frozen=True)
class RoadLeg:
    """A drive from one crossing to the next. first_ns: stamp of its first sample; heading: index of HEADINGS."""

    first_ns: int
    column: int
    row: int
    heading: int


def samples_of(hours: float) -> int:
    """How many samples `batches` gives in the first so many hours of work: whole legs, at least one."""
    return MACHINES * LEG_SAMPLES * max(1, round(hours * 3600 * 1e9 / (LEG_SAMPLES * SAMPLE_NS)))


def batches(seed: int = 0) -> Iterator[tuple[str, Table]]:
    """Names of machines and batches of samples, in the order in which they would come in, day after day."""
    draws = np.random.default_rng(seed).spawn(MACHINES)
    drives = [drive(draw) for draw in draws]
    while True:
        driven = [next(legs) for legs in drives]
        for first in range(0, LEG_SAMPLES, BATCH):
            for number, rows in enumerate(driven, start=1):
                yield f"loader-{number}", rows[first : first + BATCH]


def seconds_of(work: Iterator[tuple[str, Table]]) -> Iterator[Batches]:
    """What each machine sends in each second, as it drives on; work: as of `batches`, where all begin a leg."""
    while leg := list(islice(work, MACHINES * LEG_SAMPLES // BATCH)):
        machines = {name: np.concatenate([rows for other, rows in leg if other == name]) for name, _ in leg}
        for first in range(0, LEG_SAMPLES, A_SECOND):
            yield [(name, rows[first : first + A_SECOND]) for name, rows in machines.items()]


def drive(draw: np.random.Generator) -> Iterator[Table]:
    """Samples of one machine, leg by leg, day after day."""
    return (_drive(leg, draw) for leg in _legs(draw))


def _legs(draw: np.random.Generator) -> Iterator[RoadLeg]:
    """Legs of one machine, end to end; the night is between two days."""
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
    """Samples of one leg."""
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
    """Hex digits of a snapshot's evidence: its header names the store, which is another one each time."""
    with Checkpoint(snapshot) as checkpoint:
        parts = [checkpoint.index.tobytes(), *checkpoint.records(checkpoint.numbers_in(None))]
        return hashlib.sha256(b"".join(parts)).hexdigest()


def write_store(folder: Path, site: SiteConfig, rows: int, tail_rows: int, in_row: int = BATCH) -> None:
    """Write a journal of so many rows, and a snapshot tail_rows before its end, none where it is shorter.

    in_row: samples in a row: BATCH, or A_SECOND as machines send them that are always connected.
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
    journal.commit()
    journal.close()
