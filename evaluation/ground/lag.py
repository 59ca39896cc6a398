"""How long the estimate takes to notice that the ground has changed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from evaluation.ground.truth import LoadTrack, TrueGround
from protocol.arrays import Floats, Ints, Table
from protocol.site.ground_classes import ZONES

LEAST_RUN_M = 4.0  # a zone that is left sooner gives the estimate no time to settle
LEAST_STEP = 0.01  # of c_rr; below it noise decides
BEFORE_M = 2.0  # the front wheels cross a border before the load centre does, half a wheelbase of 1.5 m and a sample
STEP_NS = 10_000_000  # in which the true track is searched for borders
C_RR = np.array([zone.c_rr for zone in ZONES])


@dataclass(frozen=True)
class Crossing:
    """A change of zone: its instant, the distance driven so far, c_rr before and after, and when the next begins."""

    stamp_ns: int
    driven_m: float
    old: float
    new: float
    end_ns: int


def known_ns(samples: Table, lag_s: float) -> Ints:
    """When the machine knew its samples: it dates them back by the time that a change of the ground takes to show."""
    stamps: Ints = samples["stamp_ns"] + round(lag_s * 1e9)
    return stamps


def crossings(track: LoadTrack, ground: TrueGround, from_ns: int) -> list[Crossing]:
    """Changes of zone under the load centre, from one that lasts to another that lasts."""
    fine = track.at(np.arange(max(from_ns, track.stamp_ns[0]), track.stamp_ns[-1] + 1, STEP_NS))
    zone = ground.zone(fine.place_m)
    first = np.concatenate([[0], np.flatnonzero(np.diff(zone)) + 1])
    last = np.concatenate([first[1:] - 1, [len(zone) - 1]])
    run_m = fine.driven_m[last] - fine.driven_m[first]
    changes = []
    for i in range(1, len(first)):
        old, new = (float(C_RR[zone[first[k]]]) for k in (i - 1, i))
        if min(run_m[i - 1], run_m[i]) >= LEAST_RUN_M and abs(new - old) >= LEAST_STEP:
            at = first[i]
            end_ns = int(fine.stamp_ns[last[i]])
            changes.append(Crossing(int(fine.stamp_ns[at]), float(fine.driven_m[at]), old, new, end_ns))
    return changes


def lags(samples: Table, track: LoadTrack, changes: list[Crossing], lag_s: float) -> Floats:
    """Lag of each change of zone (k, 3): time [s] and distance [m] until the estimate knew it, and its place error [m].

    The estimate knows the change once it is nearer to the new zone's value than to the old one's; infinite where it is
    not before the next change. The place error is what remains after samples are dated back, positive beyond the
    border. Changes before which the estimate was not near to the old value are excluded.
    """
    samples = samples[np.isfinite(samples["c_rr"])]
    known = track.at(known_ns(samples, lag_s))
    dated_m = track.at(samples["stamp_ns"]).driven_m
    rows = [_lag(samples["c_rr"].astype(float), known, dated_m, crossing) for crossing in changes]
    return np.array([row for row in rows if row], float).reshape(-1, 3)


def _lag(c_rr: Floats, known: LoadTrack, dated_m: Floats, crossing: Crossing) -> tuple[float, float, float] | None:
    nearer = np.abs(c_rr - crossing.new) < np.abs(c_rr - crossing.old)
    early = np.flatnonzero(known.driven_m < crossing.driven_m - BEFORE_M)
    if not len(early) or nearer[early[-1]]:
        return None
    after = early[-1] + 1
    knows = after + np.flatnonzero(nearer[after:] & (known.stamp_ns[after:] <= crossing.end_ns))
    if not len(knows):
        return np.inf, np.inf, np.inf
    i = knows[0]
    lag_s = (known.stamp_ns[i] - crossing.stamp_ns) * 1e-9
    return float(lag_s), float(known.driven_m[i] - crossing.driven_m), float(dated_m[i] - crossing.driven_m)
