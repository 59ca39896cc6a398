"""What is true of segments: what machines drove on them, over which ground, and what that cost."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lab.calibration.drives import FleetDrive, Scene
from mapserver.roads.ledger import Ledgers, mean
from protocol.arrays import Bools, Floats, Ints, Table
from protocol.units import GRAVITY_MPS2
from sim.recorder import TRACKS_FOLDER


@dataclass(frozen=True)
class TrueTrack:
    """One machine's load centre at n instants: place (n, 2), direction of travel, and what the simulator has there.

    c_rr: of the ground below the wheels, by their loads; ground_c_rr: below the load centre, as it is in the end.
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
    """Of segments (k,): metres (k, 2) by direction, mean c_rr over places, work lost [J]; both c_rr as of a track."""

    metres: Floats
    c_rr: Floats
    work_j: Floats
    ground_c_rr: Floats


def true_tracks(drive: FleetDrive, scene: Scene, cache: Path) -> dict[str, TrueTrack]:
    """The tracks of all machines of a recording."""
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
    """What was driven on segments from a stamp to another."""
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
    """Stamps at which a machine had passed over half of a segment or more, from a stamp on."""
    later = track.stamp_ns >= from_ns
    inside = ledgers.place(track.place_m[later], track.heading_rad[later]).segment == segment
    begins = np.flatnonzero(np.diff(inside.astype(np.int64), prepend=0) == 1)
    ends = np.flatnonzero(np.diff(inside.astype(np.int64), append=0) == -1)
    driven = np.cumsum(track.step_m[later])
    whole = driven[ends] - driven[begins] >= ledgers.segments.length_m[segment] / 2
    return np.asarray(track.stamp_ns[later][ends[whole]], np.int64)
