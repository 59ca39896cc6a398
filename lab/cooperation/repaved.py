"""Ground repaved during the drive: passes until a map shows it, and until it could."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import cv2
import numpy as np
from scipy.spatial import cKDTree

from lab.calibration.drives import Scene
from lab.campaign.true_maps import window_of
from lab.cooperation.drives import SharedDrive
from lab.cooperation.maps import Layers, Timeline
from lab.cooperation.network import SHARE_PCT, Network, network
from lab.ground.truth import true_ground
from protocol.arrays import Bools, Floats, Ints
from protocol.site.ground_classes import resistance_class
from sim.scenario.ground import Point
from sim.simulator import START_NS
from sitegrid.proof.figures import Row
from sitegrid.proof.tracks import LoadTrack

PASSES = 12  # evaluated at most
REACH_M = 1.0  # from a load centre: farther cells were not driven, so no map could know them


def outlines(drive: SharedDrive) -> dict[str, tuple[Point, ...]]:
    """Repaved outlines by name."""
    return {name: change.outline for name, change in drive.changes.items()}


def inside(outline: Sequence[Point], place_m: Floats, margin_m: float = 0.0) -> Bools:
    """Whether places (n, 2) are inside an outline, or within margin_m."""
    corners = np.array(outline, np.float32)
    off_m = [cv2.pointPolygonTest(corners, (x, y), measureDist=True) for x, y in place_m.tolist()]
    return np.array(off_m) >= -margin_m


def repaved_rows(
    drive: SharedDrive, line: Timeline, arrivals: Timeline, true: Scene, names: Sequence[str]
) -> list[Row]:
    """Per repaved ground: passes and time until SHARE_PCT of its cells have the new class.

    Network cells at least 2 m inside. A pass starts after the change and counts on leaving the ground. least_passes:
    until SHARE_PCT of the cells were driven at all.
    """
    tracks = [true.tracks[name] for name in names]
    before = network(true_ground(drive.ground, drive.seed), ())
    rows = []
    for name, change in drive.changes.items():
        changed_ns = START_NS + round(change.at_s * 1e9)
        cells = before.part(inside(change.outline, before.place_m, -2.0))
        new = resistance_class(true.truth.c_rr[cells.row, cells.column])
        cells, new = cells.part(new != resistance_class(cells.c_rr)), new[new != resistance_class(cells.c_rr)]
        by_machine = [passes(track, inside(change.outline, track.place_m), changed_ns) for track in tracks]
        ends = np.sort(np.concatenate(by_machine))[:PASSES]
        shown_then = (_classes(layers, cells) for layers in line.maps(ends.tolist(), window_of(true.truth)))
        shown_pct = [100.0 * float((classes == new).mean()) for classes in shown_then]
        reached_pct = [driven_pct(tracks, cells.place_m, changed_ns, end) for end in ends.tolist()]
        shown, reached = _first(shown_pct), _first(reached_pct)
        row: Row = {
            "ground": name,
            "cells": len(new),
            "passes": None if shown is None else shown + 1,
            "least_passes": None if reached is None else reached + 1,
            "minutes": None,
            "arrived_min": None,
        }
        if shown is not None:
            arrived_ns = int(arrivals.time_ns[arrivals.samples["stamp_ns"] <= ends[shown]].max())
            minutes = [(stamp - changed_ns) / 60e9 for stamp in (int(ends[shown]), arrived_ns)]
            row |= {"minutes": minutes[0], "arrived_min": minutes[1]}
        rows.append(row | {"by_pass_pct": shown_pct, "driven_by_pass_pct": reached_pct})
    return rows


def _first(shares_pct: Sequence[float]) -> int | None:
    return next((i for i, share in enumerate(shares_pct) if share >= SHARE_PCT), None)


def driven_pct(tracks: Iterable[LoadTrack], place_m: Floats, from_ns: int, to_ns: int) -> float:
    """Share of places (n, 2) within REACH_M of load centres between two stamps."""
    whole = np.concatenate([track.place_m[(track.stamp_ns > from_ns) & (track.stamp_ns <= to_ns)] for track in tracks])
    off_m, _ = cKDTree(whole[np.isfinite(whole[:, 0])]).query(place_m)
    return 100.0 * float((off_m <= REACH_M).mean())


def passes(track: LoadTrack, there: Bools, from_ns: int) -> Ints:
    """Stamps (k,) of leaving a ground entered after from_ns; there (n,): presence on it."""
    begins = np.flatnonzero(np.diff(there.astype(np.int8), prepend=0) > 0)
    ends = np.flatnonzero(np.diff(there.astype(np.int8), append=0) < 0)
    whole = (track.stamp_ns[begins] > from_ns) & (ends < len(there) - 1)
    return np.asarray(track.stamp_ns[ends[whole]], np.int64)


def _classes(layers: Layers, cells: Network) -> Ints:
    return resistance_class(layers["resistance"][cells.row, cells.column])
