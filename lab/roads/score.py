"""Figures of one recording: roads against drives, ledger and losses against segments' truth."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from lab.calibration.cases import Rows
from lab.calibration.drives import FleetDrive, Scene
from lab.calibration.solving import calibrated, of_machine
from mapserver.calibration.correction import corrected
from mapserver.error_model import NINETY
from mapserver.evidence.fold_config import FoldConfig, is_foldable, name_hash
from mapserver.evidence.grid import Grid
from mapserver.roads.ledger import Ledgers, mean
from mapserver.roads.loss import Losses, losses
from mapserver.roads.network import network
from mapserver.roads.segments import SegmentTable, segments
from mapserver.roads.skeleton import Skeletons
from mapserver.roads.tally import PER_M, Tally
from mapserver.roads.worklist import TIE_SHARE, ranked
from protocol.arrays import Bools, Floats, Ints, Table
from protocol.site.geometry import CellWindow
from protocol.units import DAY_NS, GRAVITY_MPS2
from sim.recorder import TRACKS_FOLDER


@dataclass(frozen=True)
class TrueTrack:
    """One load centre at n instants: place (n, 2), direction of travel, and simulated truth.

    c_rr: below the wheels, weighted by load; ground_c_rr: below the load centre, final state.
    """

    stamp_ns: Ints
    place_m: Floats
    heading_rad: Floats
    step_m: Floats
    c_rr: Floats
    slope: Floats
    mass_kg: Floats
    ground_c_rr: Floats


@dataclass(frozen=True)
class TrueTraffic:
    """By segment (k,): metres (k, 2) by direction, mean c_rr over places, work lost [J]; both c_rr as in TrueTrack."""

    metres: Floats
    c_rr: Floats
    work_j: Floats
    ground_c_rr: Floats


def true_tracks(drive: FleetDrive, scene: Scene, cache: Path) -> dict[str, TrueTrack]:
    """Tracks of all machines of a recording."""
    out, truth = {}, scene.truth
    for name, track in scene.tracks.items():
        path = drive.folder(cache) / "truth" / TRACKS_FOLDER / f"{name}.csv"
        table: Table = np.genfromtxt(path, delimiter=",", names=True)
        heading = track.yaw_rad + np.pi * (table["speed"] < 0)
        slope = table["grade_e"] * np.cos(heading) + table["grade_n"] * np.sin(heading)
        step = np.diff(track.driven_m, prepend=0.0)
        column, row = np.floor((track.place_m - (truth.west_m, truth.south_m)) / truth.cell_m).astype(int).T
        ground = truth.c_rr[row, column]
        known = (track.stamp_ns, track.place_m, heading, step, table["c_rr"], slope, table["mass"], ground)
        out[name] = TrueTrack(*(np.asarray(column) for column in known))
    return out


def true_traffic(
    tracks: Iterable[TrueTrack], ledgers: Ledgers, target: float, from_ns: int = 0, to_ns: int = 2**62
) -> TrueTraffic:
    """Traffic on segments between two stamps."""
    count, ends = len(ledgers.segments.ids), ledgers.slices
    metres, work = np.zeros((count, 2)), np.zeros(count)
    slices = np.zeros((3, int(ends[-1])))
    for track in tracks:
        at = ledgers.place(track.place_m, track.heading_rad)
        own: Bools = (at.segment >= 0) & (track.stamp_ns >= from_ns) & (track.stamp_ns < to_ns)
        step, c_rr, slope = (values[own] for values in (track.step_m, track.c_rr, track.slope))
        excess = np.maximum(c_rr + slope, 0.0) - np.maximum(target + slope, 0.0)
        lost = track.mass_kg[own] * GRAVITY_MPS2 * step * np.maximum(excess, 0.0)
        np.add.at(metres, (at.segment[own], at.direction[own]), step)
        np.add.at(work, at.segment[own], lost)
        np.add.at(slices[0], at.slice[own], step)
        np.add.at(slices[1], at.slice[own], step * c_rr)
        np.add.at(slices[2], at.slice[own], step * track.ground_c_rr[own])
    with np.errstate(invalid="ignore"):
        c_rr, ground = (mean(each / slices[0], ends) for each in slices[1:])
    return TrueTraffic(metres, c_rr, work, ground)


def true_passes(track: TrueTrack, ledgers: Ledgers, segment: int, from_ns: int) -> Ints:
    """Stamps of passes over at least half a segment, from a stamp on."""
    later = track.stamp_ns >= from_ns
    inside = ledgers.place(track.place_m[later], track.heading_rad[later]).segment == segment
    begins = np.flatnonzero(np.diff(inside.astype(np.int64), prepend=0) == 1)
    ends = np.flatnonzero(np.diff(inside.astype(np.int64), append=0) == -1)
    driven = np.cumsum(track.step_m[later])
    whole = driven[ends] - driven[begins] >= ledgers.segments.length_m[segment] / 2
    return np.asarray(track.stamp_ns[later][ends[whole]], np.int64)


# --- figures ----------------------------------------------------------------------------------------------------------


TARGET = 0.02
NEAR_M = 3.0  # of a road
SPACING_M = 0.5  # point spacing on roads
LEAST_PASSES = 1.5  # true passes for a segment to be judged
TOP = 10
SHARE_OFF = 0.1  # of metres in one direction; more is the wrong direction
STEP_M = 0.02  # per tenth of a second, for a moving machine
EVERYWHERE = CellWindow(-20_000, -20_000, 40_000, 40_000)


@dataclass(frozen=True)
class Recorded:
    """Corrected samples of all machines, and the truth."""

    rows: Rows
    tracks: Mapping[str, TrueTrack]
    start_ns: int
    end_ns: int

    @classmethod
    def of_drive(cls, drive: FleetDrive, rows: Rows, scene: Scene, cache: Path, *, calibrates: bool = True) -> Recorded:
        """From a recording, corrected by the server's solver or not."""
        solved, config = calibrated(rows) if calibrates else None, FoldConfig()
        right = {name: corrected(table, of_machine(solved, name)) if solved else table for name, table in rows.items()}
        right = {name: table[is_foldable(table, config)] for name, table in right.items()}
        tracks = true_tracks(drive, scene, cache)
        stamps = np.concatenate([track.stamp_ns for track in tracks.values()])
        return cls(right, tracks, int(stamps.min()), int(stamps.max()))

    @property
    def half_ns(self) -> int:
        """Its middle."""
        return (self.start_ns + self.end_ns) // 2

    def part(self, from_ns: int = 0, to_ns: int = 2**62, machines: Collection[str] = ()) -> Rows:
        """Samples of a time span, and of some machines."""
        return {
            name: rows[(rows["stamp_ns"] >= from_ns) & (rows["stamp_ns"] < to_ns)]
            for name, rows in self.rows.items()
            if not machines or name in machines
        }


def grid_of(rows: Rows) -> Grid:
    """A server's evidence."""
    grid = Grid(1.0, FoldConfig())
    for name, table in rows.items():
        grid.fold(table, name)
    return grid


def roads(rows: Rows) -> SegmentTable:
    """A server's roads."""
    grid = grid_of(rows)
    blocks = grid.blocks_in(EVERYWHERE)
    pages = dict(zip(blocks, grid.pages(blocks), strict=True))
    return segments(network(Skeletons(1.0).skeleton(pages)))


def tally_of(rows: Rows) -> Tally:
    """Sum up the traffic."""
    out = Tally()
    for name, table in rows.items():
        out.add(table, np.full(len(table), name_hash(name), np.uint64))
    return out


def road_figures(recorded: Recorded, whole: SegmentTable) -> dict[str, float]:
    """Percent of drives near a road, of roads never driven, of length that keeps its name."""
    driven = np.concatenate([track.place_m[track.step_m > STEP_M] for track in recorded.tracks.values()])
    lines = np.concatenate([_dense(whole.line(i)) for i in range(len(whole.ids))])
    off_m, _ = cKDTree(lines).query(driven)
    beyond_m, _ = cKDTree(driven).query(lines)
    halves = [roads(recorded.part(*span)) for span in ((0, recorded.half_ns), (recorded.half_ns,))]
    names = sorted(recorded.rows)
    fleets = [roads(recorded.part(machines=some)) for some in (names[::2], names[1::2])]
    return {
        "km": float(whole.length_m.sum() / 1000),
        "driven_pct": 100.0 * float((off_m < NEAR_M).mean()),
        "false_pct": 100.0 * float((beyond_m > NEAR_M).mean()),
        "kept_half_pct": min(_kept(part, whole) for part in halves),
        "kept_machines_pct": min(_kept(part, whole) for part in fleets),
    }


def kept_after(recorded: Recorded, later: Recorded, whole: SegmentTable) -> float:
    """Percent of road length that keeps its names after another day on other ground."""
    names = recorded.rows.keys() | later.rows.keys()
    after_ns = DAY_NS + recorded.start_ns - later.start_ns
    both = {}
    for name in sorted(names):
        own, next_day = (each.rows.get(name) for each in (recorded, later))
        parts = [] if own is None else [own]
        if next_day is not None:
            moved = next_day.copy()
            moved["stamp_ns"] += after_ns
            parts.append(moved)
        both[name] = np.concatenate(parts)
    return _kept(whole, roads(both))


def _dense(line: Floats) -> Floats:
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    at = np.arange(0.0, along[-1], SPACING_M)
    return np.stack([np.interp(at, along, line[:, axis]) for axis in (0, 1)], axis=1)


def _kept(part: SegmentTable, whole: SegmentTable) -> float:
    """Percent of a partial map's road length with names of the whole map."""
    names = set(whole.ids)
    kept = np.array([name in names for name in part.ids])
    return 100.0 * float(part.length_m[kept].sum() / part.length_m.sum())


def traffic_figures(recorded: Recorded, whole: SegmentTable) -> dict[str, float]:
    """Passes, resistance and losses of segments against the truth."""
    ledgers, tally = Ledgers(whole), tally_of(recorded.rows)
    ledger = ledgers.ledger(tally.table(), tally.slot_ns)
    known, true = losses(ledger, whole, TARGET), true_traffic(recorded.tracks.values(), ledgers, TARGET)
    metres = ledger.totals()["metres"] / PER_M
    judged = judged_segments(true, whole)
    ratio = metres.sum(axis=1)[judged] / true.metres.sum(axis=1)[judged]
    share, right = (each[judged, 0] / each[judged].sum(axis=1) for each in (metres, true.metres))
    measured = judged & np.isfinite(known.c_rr) & np.isfinite(true.c_rr)
    off = (known.c_rr - true.c_rr)[measured]
    off_ground = (known.c_rr / true.ground_c_rr - 1)[measured]
    return {
        "segments": int(judged.sum()),
        "passes_pct": 100.0 * float((np.abs(ratio - 1) < 0.1).mean()),
        "direction_pct": 100.0 * float((np.abs(share - right) < SHARE_OFF).mean()),
        "c_pct": 100.0 * float(np.sqrt(np.mean((off / true.c_rr[measured]) ** 2))),
        "c_ground_pct": 100.0 * float(np.sqrt(np.mean(off_ground**2))),
        "c_median_pct": 100.0 * float(np.median(np.abs(off / true.c_rr[measured]))),
        "inside_pct": 100.0 * float((np.abs(off) <= NINETY * known.c_std[measured]).mean()),
        **_list_figures(known, true, judged),
    }


def judged_segments(true: TrueTraffic, whole: SegmentTable) -> Bools:
    """Segments (k,) driven often enough."""
    return np.asarray(true.metres.sum(axis=1) > LEAST_PASSES * whole.length_m, np.bool_)


def _list_figures(known: Losses, true: TrueTraffic, judged: Bools) -> dict[str, float]:
    """Order and sum of losses.

    tau: ties in truth and list; tau_ranks: list ties are its ranks; tau_plain: ties in the truth only; tau_plain_most:
    its upper bound, from the true losses, since an order without ties cannot match one with ties.
    """
    own, right = known.work_j[judged], true.work_j[judged]
    best, listed = np.argsort(-right)[:TOP], np.argsort(-own, kind="stable")[:TOP]
    own_tie, tie = (TIE_SHARE * work.max(initial=0.0) for work in (own, right))
    ranks, shown = np.full(len(judged), np.inf), ranked(known)
    ranks[shown.order] = shown.rank
    place = -np.minimum(ranks, len(ranks) + 1)[judged]  # unlisted segments tie at the end
    return {
        "tau": kendall(own, right, own_tie, tie),
        "tau_ranks": kendall(place, right, 0.0, tie),
        "tau_plain": kendall(own, right, 0.0, tie),
        "tau_plain_most": kendall(right, right, 0.0, tie),
        "top_pct": 100.0 * float(right[listed].sum() / max(right[best].sum(), 1e-9)),
        "total_pct": 100.0 * float(own.sum() / max(right.sum(), 1e-9) - 1),
    }


def kendall(one: Floats, other: Floats, one_tie: float, other_tie: float) -> float:
    """Kendall's tau-b of two orders; values closer than a tie's width are tied."""
    i, j = np.triu_indices(len(one), 1)
    signs = []
    for values, tie in ((one, one_tie), (other, other_tie)):
        difference = values[i] - values[j]
        signs.append(np.where(np.abs(difference) < tie, 0.0, np.sign(difference)))
    pairs = np.sqrt((signs[0] != 0).sum() * float((signs[1] != 0).sum()))
    return float((signs[0] * signs[1]).sum() / max(pairs, 1.0))
