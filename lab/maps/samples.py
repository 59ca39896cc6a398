"""Samples of a case's machines with truth, simulated without localisation.

Position errors are Gauss-Markov, like those of GPS; with white errors every merge looks good.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter

from lab.maps.cases import CELL_M, PASSES_BEFORE, CaseMachine, MapCase, Site, build_site, parking_place
from mapserver.evidence.fold_config import FoldConfig
from protocol.arrays import Bools, Floats, Ints, Table
from protocol.machine.samples import empty

PERIOD_NS = 200_000_000  # 5 Hz
SPEED_MPS = 3.0
STEP_M = SPEED_MPS * PERIOD_NS * 1e-9
LANE_M = 1.0
ERROR_TIME_S = 30.0  # correlation time of position errors
C_RR_STD = 0.002
# Gradient errors along and across: white, and a per-machine bias in machine axes (0.1 degrees).
GRADE_STD, GRADE_BIAS_STD = 0.004, 0.0017
START_NS = 1_772_433_000_000_000_000  # 2026-03-02 06:30 UTC; days start up to ten minutes later
START_WITHIN_NS = 600_000_000_000
BATCH_ROWS = 100
LATENCY_NS = 150_000_000  # from a batch's last sample to receipt
BUCKET_NS = round(FoldConfig().bucket_s * 1e9)


class Delivery(NamedTuple):
    """A batch as received. rows: SAMPLE_DTYPE, by stamp."""

    machine: str
    rows: Table
    received_ns: int


@dataclass(frozen=True)
class Sweep:
    """True track of a machine per sample: place [m], heading [rad], pass number from 0."""

    x_m: Floats
    y_m: Floats
    heading_rad: Floats
    number: Ints


@dataclass(frozen=True)
class MapScene:
    """A simulated case: sent samples, and truth.

    deliveries: of all machines, in order of arrival. site: true ground; `c_rr_later`: final. repaved_ns: None: never.
    driven: truly passed cells (rows, columns).
    """

    deliveries: tuple[Delivery, ...]
    site: Site
    repaved_ns: int | None
    driven: Bools

    @property
    def samples(self) -> int:
        """Number of samples."""
        return sum(len(delivery.rows) for delivery in self.deliveries)


def simulate(case: MapCase, seed: int) -> MapScene:
    """All samples of a case; reproducible to the byte."""
    site = build_site(case)
    draw, *draws = np.random.default_rng(seed).spawn(1 + len(case.machines))
    start_ns = START_NS + int(draw.integers(START_WITHIN_NS))
    sweeps = _sweeps(case, draws)
    stamps = [
        start_ns + int(rng.integers(PERIOD_NS)) + PERIOD_NS * np.arange(len(sweep.x_m))
        for sweep, rng in zip(sweeps, draws, strict=True)
    ]
    repaved_ns = _repaved_ns(site, sweeps[0], stamps[0], draw) if case.passes_after is not None else None
    sent: list[Delivery] = []
    driven = np.zeros(site.c_rr.shape, np.bool_)
    for i, (machine, sweep, stamp_ns, rng) in enumerate(zip(case.machines, sweeps, stamps, draws, strict=True)):
        sent += batches(f"machine{i + 1}", sense(machine, sweep, stamp_ns, site, repaved_ns, rng))
        if not machine.parked:
            driven |= passed(sweep, site)
    return MapScene(tuple(sorted(sent, key=lambda delivery: delivery.received_ns)), site, repaved_ns, driven)


# --- sweeps ----------------------------------------------------------------------------------------------------------


def sweep_lanes(case: MapCase, machine: CaseMachine, draw: np.random.Generator) -> Sweep:
    """All passes of a machine; turns between lanes are off the site and not sampled."""
    passes = [_pass(case, machine.first + i, float(draw.uniform(0, LANE_M))) for i in range(machine.passes)]
    number = np.repeat(np.arange(len(passes)), [len(x) for x, _, _ in passes])
    x, y, heading = (np.concatenate(parts) for parts in zip(*passes, strict=True))
    return Sweep(x, y, heading, number)


def _sweeps(case: MapCase, draws: list[np.random.Generator]) -> list[Sweep]:
    """Sweeps of all machines; parked ones stand until the longest ends."""
    sweeps = [None if m.parked else sweep_lanes(case, m, rng) for m, rng in zip(case.machines, draws, strict=True)]
    longest = max(len(sweep.x_m) for sweep in sweeps if sweep)
    x_m, y_m = (np.full(longest, place_m) for place_m in parking_place(case))
    stands = Sweep(x_m, y_m, np.zeros(longest), np.zeros(longest, np.int64))
    return [sweep or stands for sweep in sweeps]


def _pass(case: MapCase, number: int, offset_m: float) -> tuple[Floats, Floats, Floats]:
    """East, north [m], heading [rad] of one pass: lanes there and back."""
    across = number % 2 == 1
    length, width = (case.rows, case.columns) if across else (case.columns, case.rows)
    along = np.arange(STEP_M / 2, length * CELL_M, STEP_M)
    lanes = np.arange(0.0, width * CELL_M, LANE_M) + offset_m
    back = (np.arange(len(lanes)) % 2 == 1)[:, None]
    forward = np.where(back, along[::-1], along).ravel()
    sideways = np.repeat(lanes, len(along))
    heading = np.broadcast_to(np.where(back, np.pi, 0.0), (len(lanes), len(along))).ravel()
    if across:
        return sideways, forward, np.where(heading > 0, -np.pi / 2, np.pi / 2)
    return forward, sideways, heading


def passed(sweep: Sweep, site: Site) -> Bools:
    """Passed cells (rows, columns); steps are shorter than cells, so both ends suffice."""
    cells = np.zeros(site.c_rr.shape, np.bool_)
    for end_m in (-STEP_M / 2, STEP_M / 2):
        x_m, y_m = sweep.x_m + end_m * np.cos(sweep.heading_rad), sweep.y_m + end_m * np.sin(sweep.heading_rad)
        cells[cell_of(x_m, y_m, site)] = True
    return cells


def cell_of(x_m: Floats, y_m: Floats, site: Site) -> tuple[Ints, Ints]:
    """Row and column of places, clipped to the site."""
    rows, columns = site.c_rr.shape
    row, column = (np.floor(v / CELL_M).astype(np.int64) for v in (y_m, x_m))
    return np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)


def _repaved_ns(site: Site, sweep: Sweep, stamp_ns: Ints, draw: np.random.Generator) -> int:
    """An instant with the machine in the zone, well inside a time bucket."""
    there = site.repaved[cell_of(sweep.x_m, sweep.y_m, site)] & (sweep.number == PASSES_BEFORE - 1)
    about_ns = int(stamp_ns[there][int(draw.uniform(0.1, 0.9) * there.sum())])
    return about_ns // BUCKET_NS * BUCKET_NS + int(draw.uniform(0.2, 0.8) * BUCKET_NS)


# --- samples ---------------------------------------------------------------------------------------------------------


def sense(
    machine: CaseMachine, sweep: Sweep, stamp_ns: Ints, site: Site, repaved_ns: int | None, draw: np.random.Generator
) -> Table:
    """Samples of a machine along its sweep."""
    n = len(stamp_ns)
    at = cell_of(sweep.x_m, sweep.y_m, site)
    later = np.zeros(n, np.bool_) if repaved_ns is None else stamp_ns >= repaved_ns
    c_rr = machine.gain * np.where(later, site.c_rr_later[at], site.c_rr[at])
    gradient = site.gradient[at] + _gradient_error(sweep.heading_rad, draw)
    rows = empty(n)
    rows["stamp_ns"] = stamp_ns
    rows["x_m"] = sweep.x_m + machine.offset_m + gauss_markov(n, machine.std_m, draw)
    rows["y_m"] = sweep.y_m + gauss_markov(n, machine.std_m, draw)
    rows["cov_xx_m2"] = rows["cov_yy_m2"] = machine.std_m**2
    rows["heading_rad"] = sweep.heading_rad
    rows["speed_mps"], rows["distance_m"] = (0.0, 0.0) if machine.parked else (SPEED_MPS, STEP_M)
    rows["c_rr"], rows["c_rr_var"] = c_rr + draw.normal(0.0, C_RR_STD, n), C_RR_STD**2
    rows["grade_e"], rows["grade_n"] = gradient.T
    rows["grade_var"] = GRADE_STD**2 + GRADE_BIAS_STD**2
    return rows


def gauss_markov(n: int, std: float, draw: np.random.Generator) -> Floats:
    """Stationary errors (n,), one per period: b+ = exp(-dt/tau) b + std sqrt(1 - exp(-2 dt/tau)) w."""
    kept = np.exp(-PERIOD_NS * 1e-9 / ERROR_TIME_S)
    noise = draw.normal(0.0, std * np.sqrt(1 - kept**2), n)
    noise[:1] = draw.normal(0.0, std)
    return np.asarray(lfilter([1.0], [1.0, -kept], noise), np.float64)


def batches(machine: str, rows: Table) -> Iterator[Delivery]:
    """Split a machine's samples into batches."""
    for first in range(0, len(rows), BATCH_ROWS):
        batch = rows[first : first + BATCH_ROWS]
        yield Delivery(machine, batch, int(batch["stamp_ns"][-1]) + LATENCY_NS)


def _gradient_error(heading_rad: Floats, draw: np.random.Generator) -> Floats:
    """Errors east and north (n, 2) of gradients measured along and across."""
    n = len(heading_rad)
    along, across = draw.normal(0.0, GRADE_STD, (2, n)) + draw.normal(0.0, GRADE_BIAS_STD, (2, 1))
    cos, sin = np.cos(heading_rad), np.sin(heading_rad)
    return np.stack([cos * along - sin * across, sin * along + cos * across], axis=-1)
