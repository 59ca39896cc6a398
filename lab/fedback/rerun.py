"""Rerun the filter from its nodes with lane windows as measurements; live, and smoothed with a lag."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from agents.dead_reckoning import DeadReckonedPose
from agents.localisation.filters.belief import FREED, Belief, Measurement
from agents.localisation.filters.motion import BESIDE_S, BESIDE_STD_M, OFFSET_WALK
from agents.localisation.filters.smoother import KEPT
from agents.localisation.filters.state import BASE_STATES, Layout
from agents.localisation.lanes.aid import LaneAid
from agents.localisation.lanes.guards import share_of
from agents.localisation.lanes.lane_map import LaneMap
from agents.localisation.localiser import PROVEN_S
from agents.sampling import LAG_NS
from lab.fedback.nodes import Nodes
from protocol.arrays import Floats, Table

LAG = 90  # nodes
Maps = Callable[[int], LaneMap | None]  # an agent's map at a stamp


@dataclass(frozen=True)
class Course:
    """Nodes, live and smoothed: errors (n, 2), covariances (n, 2, 2); counts: outcomes of windows.

    shares (n,): the lanes' part in the smoothed position.
    """

    live_m: Floats
    live_m2: Floats
    smoothed_m: Floats
    smoothed_m2: Floats
    shares: Floats
    counts: Counter[str]
    guards: Floats  # m, l (k, 3) after each window


class _Smoother:
    """Nodes in the lag and the state, jointly: mean (q, 3), covariance (q, 3, 3), cross-covariance (q, 3, s)."""

    def __init__(self, states: int, offset_m2: float) -> None:
        """offset_m2: prior variance of the map's offset, 0: not a state."""
        self.mean, self.P, self.C = np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, 3, states))
        self.final: list[tuple[Floats, Floats, float]] = []
        self.offset_m2 = offset_m2

    def add(self, mean: Floats, P: Floats) -> None:
        if len(self.mean) == LAG:
            self.final.append((self.mean[0], self.P[0], self._share(self.C[0])))
        keep = slice(len(self.mean) == LAG, None)
        self.mean = np.concatenate([self.mean[keep], mean[None, KEPT]])
        self.P = np.concatenate([self.P[keep], P[None][:, KEPT][:, :, KEPT]])
        self.C = np.concatenate([self.C[keep], P[None, KEPT]])

    def inform(self, vector: Floats, information: Floats, moved: Floats) -> None:
        """Apply information (s, s) and vector (s,) on the state, then its motion (s, s)."""
        self.mean = self.mean + self.C @ vector
        self.P = self.P - self.C @ information @ self.C.transpose(0, 2, 1)
        self.C = self.C @ moved.T

    def all(self) -> tuple[Floats, Floats, Floats]:
        """All nodes so far: positions (n, 2), covariances (n, 2, 2), shares (n,)."""
        shares = map(self._share, self.C)
        means, covariances, aided = zip(*self.final, *zip(self.mean, self.P, shares, strict=True), strict=True)
        return np.array(means)[:, :2], np.array(covariances)[:, :2, :2], np.array(aided)

    def _share(self, cross: Floats) -> float:
        return share_of(cross[:2, -3:-1], self.offset_m2) if self.offset_m2 else 0.0


def rerun(nodes: Nodes, maps: Maps, *, aids: bool = True) -> Course:
    """Rerun the filter. aids False: the original one."""
    n, begin_ns = nodes.x.shape[1], int(nodes.stamp_ns[0])
    layout = Layout(n - BASE_STATES, lanes=aids)  # only where its guards are matters
    aid = LaneAid(nodes.ahead_m)
    aid.lanes = maps(begin_ns)
    prior = aid.variances_m2(begin_ns)
    d, P = np.zeros(layout.n), np.zeros((layout.n, layout.n))
    P[:n, :n] = nodes.P[0]
    if aids:
        P[n:, n:] = np.diag(prior)
    smoother, live, live_m2, seen, follow = _Smoother(layout.n, float(prior[0]) * aids), [], [], [], _Follower(nodes)
    for k, stamp_ns in enumerate(nodes.stamp_ns.tolist()):
        if k:
            d, P = _moved(nodes, k - 1, d, P, smoother)
        is_due = aids and follow(aid, stamp_ns)
        mean = np.pad(nodes.x[k], (0, layout.n - n))
        if is_due:
            aid.is_due(_reckoned(nodes, stamp_ns))
            aid.lanes = maps(stamp_ns)
        for measure in (aid.measurement, aid.slope_measurement) if is_due else ():
            if not (shown := measure(Belief(stamp_ns, mean + d, P))):
                continue
            d, P, nis = _conditioned(shown, mean, d, P, smoother)
            aid.counters[f"{shown.sensor}_used"] += 1
            seen.append(d[n:].copy())
            if not aid.judge(Belief(stamp_ns, mean + d, P), nis, layout):
                d, P = _freed(d, P, n, prior, smoother)
                d[n:], P[n:, :], P[:, n:] = 0.0, 0.0, 0.0
                P[n:, n:] = np.diag(prior)
                smoother.C[:, :, n:] = 0.0
        x = nodes.x[k] + d[:n]
        live.append(x[:2])
        live_m2.append(P[:2, :2].copy())
        smoother.add(x, P)
    places, smoothed_m2, shares = smoother.all()
    courses = np.array(live) - nodes.true_m, np.array(live_m2), places - nodes.true_m, smoothed_m2
    return Course(*courses, shares, aid.counters, np.array(seen))


class _Follower:
    """Gives an aid what an agent gets once the heading is proven: the way, and slopes LAG_NS later."""

    def __init__(self, nodes: Nodes) -> None:
        self._nodes, self._at, self._felt = nodes, 0, 0
        self._at = int(np.searchsorted(nodes.way_ns, nodes.stamp_ns[0] + round(PROVEN_S * 1e9)))

    def __call__(self, aid: LaneAid, stamp_ns: int) -> bool:
        """Up to a stamp; returns whether a window has ended."""
        nodes, is_due = self._nodes, False
        felt = int(np.searchsorted(nodes.felt["stamp_ns"], stamp_ns - LAG_NS, side="right"))
        for way_ns in nodes.way_ns[self._at :][nodes.way_ns[self._at :] <= stamp_ns].tolist():
            is_due, self._at = aid.is_due(_reckoned(nodes, way_ns)), self._at + 1
        aid.feel(nodes.felt[self._felt : felt])
        self._felt = max(self._felt, felt)
        return is_due


def placed_again(nodes: Nodes, without: Course, aided: Course) -> Table:
    """Samples at lane-aided positions with the lanes' share; without: the rerun without lanes."""
    rows, moved_m = nodes.rows.copy(), aided.smoothed_m - without.smoothed_m
    for axis, name in enumerate(("x_m", "y_m")):
        rows[name] += np.interp(rows["stamp_ns"], nodes.stamp_ns, moved_m[:, axis])
    P = aided.smoothed_m2
    values_of = {"cov_xx_m2": P[:, 0, 0], "cov_xy_m2": P[:, 0, 1], "cov_yy_m2": P[:, 1, 1], "aid_share": aided.shares}
    for name, values in values_of.items():
        rows[name] = np.interp(rows["stamp_ns"], nodes.stamp_ns, values)
    return rows


def _reckoned(nodes: Nodes, stamp_ns: int) -> DeadReckonedPose:
    """Dead reckoning at a stamp."""
    x_m, y_m, angle_rad = (float(np.interp(stamp_ns, nodes.way_ns, nodes.way[:, i])) for i in range(3))
    return DeadReckonedPose(stamp_ns, 0.0, angle_rad, x_m, y_m)


def _freed(d: Floats, P: Floats, n: int, prior_m2: Floats, smoother: _Smoother) -> tuple[Floats, Floats]:
    """As `freed` of beliefs does: the states from n on had been assumed with these variances (3,)."""
    of_guards, H = P[n:], np.eye(len(d))[n:]
    S = of_guards[:, n:] - np.diag(np.maximum(prior_m2, of_guards[:, n:].diagonal()) / (1 - 1 / FREED))
    gain = np.linalg.solve(S, H)
    K = P @ gain.T
    smoother.inform(-gain.T @ d[n:], H.T @ gain, np.eye(len(d)) - K @ H)
    return d - K @ d[n:], P - K @ of_guards


def _conditioned(
    shown: Measurement, mean: Floats, d: Floats, P: Floats, smoother: _Smoother
) -> tuple[Floats, Floats, float]:
    """Update by a measurement; also its normalised squared innovation per component."""
    H, R = shown.jacobian(mean), shown.R
    y, S = shown.z - H @ (mean + d), H @ P @ H.T + R
    gain = np.linalg.solve(S, H)
    K = P @ gain.T
    kept = np.eye(len(d)) - K @ H
    smoother.inform(gain.T @ y, H.T @ gain, kept)
    return d + K @ y, kept @ P @ kept.T + K @ R @ K.T, float(y @ np.linalg.solve(S, y)) / len(y)


def _moved(nodes: Nodes, k: int, d: Floats, P: Floats, smoother: _Smoother) -> tuple[Floats, Floats]:
    """Propagate from node k to the next."""
    n, states = nodes.x.shape[1], len(d)
    A, W, J, j, shift = np.eye(states), np.zeros_like(P), np.zeros_like(P), np.zeros(states), np.zeros(states)
    A[:n, :n], W[:n, :n], J[:n, :n] = nodes.A[k], nodes.W[k], nodes.J[k]
    j[:n], shift[:n] = nodes.j[k], nodes.shift[k]
    if states > n:
        dt_s = float(nodes.stamp_ns[k + 1] - nodes.stamp_ns[k]) * 1e-9
        kept, walked_m2 = np.exp(-dt_s / BESIDE_S), OFFSET_WALK**2 * dt_s
        A[-1, -1], W[-1, -1] = kept, BESIDE_STD_M**2 * (1 - kept**2)
        W[n, n] = W[n + 1, n + 1] = walked_m2
    M = J @ np.linalg.inv(np.eye(states) + P @ J)
    vector = j - J @ d
    vector = vector - M @ (P @ vector)
    smoother.inform(vector, M, A @ (np.eye(states) - P @ M))
    return A @ (d + P @ vector - shift), A @ (P - P @ M @ P) @ A.T + W
