"""The fixed-lag smoother: what the present says of the past (Anderson & Moore 1979, Optimal Filtering, 7.3).

A node is the last belief of a second, reduced to s = (x, y, yaw): mean m (3,), covariance P_s (3, 3), and
cross-covariance C = cov(s, x) (3, n) with the present state x. Every step maps the present's error linearly and adds
independent noise. F, H: Jacobians (EKF) or sigma-point regressions (UKF):

    motion, change of the state    C <- C F^T
    measurement                    m += C H^T S^-1 y      P_s -= C H^T S^-1 H C^T      C <- C (I - K H)^T

These maps are the same for all nodes: accumulated, at a cost independent of the lag, and applied once a second:

    Phi = product of F and I - K H    adjoint = sum of Phi^T H^T S^-1 y    information = sum of Phi^T H^T S^-1 H Phi

    m += C adjoint                    P_s -= C information C^T             C <- C Phi^T

(Adjoint variables of the modified Bryson-Frazier smoother, Bierman 1973.)
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from agents.localisation.filters.state import YAW, X, Y
from protocol.arrays import Floats, Ints
from protocol.rotations import wrap_angle

NODE_NS = 1_000_000_000
KEPT = [X, Y, YAW]
MIN_VARIANCE = 1e-8  # floor along any axis [m2, rad2], 0.1 mm, against rounding


@dataclass(frozen=True)
class SmoothedPose:
    """A past pose given later measurements: position [m], heading [rad, in +-pi], covariance (2, 2).

    correction: x, y [m], heading [rad] (3,) less the filter's. cross: (3, n), with the last known state. aid_share:
    from lanes, 0 to 1.
    """

    stamp_ns: int
    x_m: float
    y_m: float
    heading_rad: float
    covariance_m2: Floats
    correction: Floats
    cross: Floats
    aid_share: float = 0.0


class Nodes(NamedTuple):
    """Past places and headings [m, m, rad], oldest first, not wrapped.

    stamp_ns: (q,). filtered: (q, 3), as believed then. mean: (q, 3), covariance: (q, 3, 3), as known now. cross: (q, 3,
    n), with the state.
    """

    stamp_ns: Ints
    filtered: Floats
    mean: Floats
    covariance: Floats
    cross: Floats


@dataclass(frozen=True, slots=True)
class Past:
    """Nodes of the last lag_ns, and the accumulated maps since their update.

    final: nodes that the last motion moved out of the lag. transition: Phi (n, n). adjoint: (n,). information: (n, n).
    """

    lag_ns: int
    nodes: Nodes
    final: tuple[SmoothedPose, ...]
    transition: Floats
    adjoint: Floats
    information: Floats

    def advanced(self, stamp_ns: int, x: Floats, P: Floats, F: Floats, to_ns: int) -> "Past":
        """After a motion F (n, n) from x, P at stamp_ns, a node if its second is over."""
        if to_ns // NODE_NS == stamp_ns // NODE_NS:
            return Past(self.lag_ns, self.nodes, (), F.dot(self.transition), self.adjoint, self.information)
        nodes = self.nodes_with(stamp_ns, x, P)
        over = int(np.searchsorted(nodes.stamp_ns, stamp_ns - self.lag_ns, side="right"))
        final = tuple(_poses(nodes, over)) if over else ()
        rest = Nodes._make(values[over:] for values in nodes) if over else nodes
        return Past(self.lag_ns, rest, final, F, np.zeros(len(x)), np.zeros((len(x), len(x))))

    def mapped(self, M: Floats) -> "Past":
        """After a change that maps the state's error by M (n, n)."""
        return replace(self, transition=M.dot(self.transition))

    def extended(self, more: int) -> "Past":
        """With `more` states, unknown to the past."""
        square, n = (0, more), len(self.adjoint)
        nodes = self.nodes._replace(cross=np.pad(self.nodes.cross, ((0, 0), (0, 0), square)))
        transition = np.eye(n + more)
        transition[:n, :n] = self.transition
        information = np.pad(self.information, (square, square))
        return Past(self.lag_ns, nodes, self.final, transition, np.pad(self.adjoint, square), information)

    def informed(self, shown: Floats, weighted: Floats, y: Floats, K: Floats) -> "Past":
        """After a measurement y (k,), gain K (n, k); shown: H Phi (k, n), weighted: its transpose times S^-1."""
        return Past(
            self.lag_ns,
            self.nodes,
            self.final,
            self.transition - K.dot(shown),
            self.adjoint + weighted.dot(y),
            self.information + weighted.dot(shown),
        )

    def poses(self, stamp_ns: int, x: Floats, P: Floats) -> list[SmoothedPose]:
        """All nodes as known now, and the belief x, P."""
        return _poses(self.nodes_with(stamp_ns, x, P))

    def nodes_with(self, stamp_ns: int, x: Floats, P: Floats) -> Nodes:
        """Updated nodes, and the belief x, P."""
        _, filtered, mean, covariance, cross = self.nodes
        flat = cross.reshape(-1, len(x))
        fell = flat.dot(self.information).reshape(cross.shape) @ cross.transpose(0, 2, 1)
        s, C = x[None, KEPT], P[None, KEPT]
        return Nodes(
            np.append(self.nodes.stamp_ns, stamp_ns),
            np.concatenate([filtered, s]),
            np.concatenate([mean + flat.dot(self.adjoint).reshape(-1, 3), s]),
            np.concatenate([covariance - (fell + fell.transpose(0, 2, 1)) / 2, C[:, :, KEPT]]),
            np.concatenate([flat.dot(self.transition.T).reshape(cross.shape), C]),
        )


def nothing_past(n: int, lag_s: float) -> Past | None:
    """The empty past of n states; None without smoothing."""
    if not lag_s:
        return None
    nodes = Nodes(np.zeros(0, np.int64), *(np.zeros((0, *shape)) for shape in ((3,), (3,), (3, 3), (3, n))))
    return Past(round(lag_s * 1e9), nodes, (), np.eye(n), np.zeros(n), np.zeros((n, n)))


def _poses(nodes: Nodes, end: int | None = None) -> list[SmoothedPose]:
    rows = zip(*(values[:end] for values in nodes), strict=True)
    return [_pose(int(stamp_ns), *values) for stamp_ns, *values in rows]


def _pose(stamp_ns: int, filtered: Floats, mean: Floats, covariance: Floats, cross: Floats) -> SmoothedPose:
    x, y, heading = mean.tolist()
    return SmoothedPose(stamp_ns, x, y, wrap_angle(heading), _floored(covariance[:2, :2]), mean - filtered, cross)


def _floored(covariance: Floats) -> Floats:
    """The covariance with eigenvalues of at least MIN_VARIANCE."""
    values, vectors = np.linalg.eigh(covariance)
    if values[0] >= MIN_VARIANCE:
        return covariance
    floored: Floats = (vectors * np.maximum(values, MIN_VARIANCE)).dot(vectors.T)
    return floored
