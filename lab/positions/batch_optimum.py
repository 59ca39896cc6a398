"""The batch optimum of a run: the most probable track, given all that the EKF used; it judges the smoother.

Every belief of the filter becomes a state x_k of a factor graph, every motion, change and accepted measurement a factor
with the filter's own model f, h and covariance Q, R. GTSAM finds the states that make them most probable together, by
Gauss-Newton steps from where the filter was, all models linearised anew until nothing moves:

    |x_0 - x|_P^2 + sum |x_k - f(x_k-1)|_Q^2 + sum |z - h(x_k)|_R^2 = min

So it has the filter's gates and the filter's noise, and shows what linearising once, and the lag, cost; not whether the
model is right. Two things differ. Q is a little larger (`FLOOR`) where it is singular, as for the place of a machine at
rest. And the wheels' model stays linear at the filter's states: it multiplies speed by scale, and the most probable
speeds and scale together are not the most probable scale: each of thousands of speeds has its noise, which shrinks as
speeds shrink, so that the sum falls as the scale grows. It moved the track of a drive's first minute by 1.2 m.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from importlib import import_module

import numpy as np
from scipy.linalg import cholesky, solve_triangular

from agents.localisation.filters.belief import Belief, Measurement, Motion
from agents.localisation.filters.square_root import wrapped
from agents.localisation.filters.state import ANGLES, POSITION
from lab.positions.filter_steps import LinearChange, Step
from protocol.arrays import Floats
from protocol.errors import SitegridError

FLOOR = 1e-10  # of each state's variance, as noise of every step: ten thousand of them add a millionth
MOST_ITERATIONS = 20
STILL_M = 1e-4  # no place moves by more in the last iteration
PRODUCTS = ("wheels",)  # sensors whose model multiplies states

Factor = tuple[tuple[int, ...], Callable[..., tuple[Floats, ...]]]  # states; whitened error and Jacobians, at them


def optimum(steps: Sequence[Step]) -> dict[int, Floats]:
    """Most probable state (n,) by stamp; steps: of one run, oldest first. Needs GTSAM (extra `oracle`)."""
    gtsam = import_module("gtsam")
    factors, states, stamps = _graph(steps)
    ones = [gtsam.noiseModel.Unit.Create(size) for size in range(len(steps[0].x) + 1)]
    for _ in range(MOST_ITERATIONS):
        linear = gtsam.GaussianFactorGraph()
        for keys, at in factors:
            error, *jacobians = at(*states[list(keys)])
            blocks = [part for pair in zip(keys, jacobians, strict=True) for part in pair]
            linear.add(gtsam.JacobianFactor(*blocks, -error, ones[len(error)]))
        solution = linear.optimize()
        move = np.array([solution.at(key) for key in range(len(states))])
        states = states + move
        if np.abs(move[:, POSITION]).max() < STILL_M:
            return dict(zip(stamps, states, strict=True))
    raise SitegridError(f"the batch optimum still moves after {MOST_ITERATIONS} iterations")


def _graph(steps: Sequence[Step]) -> tuple[list[Factor], Floats, list[int]]:
    """Factors, the states (m, n) that the filter had, and their stamps."""
    factors: list[Factor] = []
    states: list[Floats] = []
    stamps: list[int] = []
    for step in steps:
        what, last = step.what, len(states) - 1
        if isinstance(what, Measurement):
            factors.append(((last,), _measured(_linearised(what, states[last]) if what.sensor in PRODUCTS else what)))
            states[last] = _near(step.x, states[last])
            continue
        states.append(_near(step.x, states[-1]) if states else step.x)
        stamps.append(step.stamp_ns)
        if isinstance(what, Belief):
            factors.append(((0,), _known(what)))
        else:
            factors.append(((last, last + 1), _moved(what, FLOOR * step.variances)))
    return factors, np.array(states), stamps


def _near(x: Floats, other: Floats) -> Floats:
    """The same state (n,), with angles less than half a turn from those of another: none jumps by a turn."""
    return other + wrapped(x - other, ANGLES)


def _moved(what: Motion | LinearChange, floor: Floats) -> Callable[..., tuple[Floats, ...]]:
    """x_k - f(x_k-1), by Q."""
    W = _whitener((what.Q if isinstance(what, Motion) else what.V) + np.diag(floor))

    def at(before: Floats, after: Floats) -> tuple[Floats, ...]:
        if isinstance(what, LinearChange):
            return W.dot(after - what.M.dot(before) - what.c), -W.dot(what.M), W
        return W.dot(after - what.f(before[None])[0]), -W.dot(what.jacobian(before)), W

    return at


def _measured(what: Measurement) -> Callable[..., tuple[Floats, ...]]:
    """h(x_k) - z, by R."""
    W = _whitener(what.R)

    def at(x: Floats) -> tuple[Floats, ...]:
        return W.dot(wrapped(what.h(x[None])[0] - what.z, what.angles)), W.dot(what.jacobian(x))

    return at


def _known(what: Belief) -> Callable[..., tuple[Floats, ...]]:
    """x_0 less the mean of the first belief, by its P."""
    W = _whitener(what.P)
    return lambda x: (W.dot(x - what.x), W)


def _linearised(what: Measurement, x: Floats) -> Measurement:
    """The measurement with its model linear at a state."""
    z, H = what.h(x[None])[0], what.jacobian(x)
    return replace(what, h=lambda states: z + (states - x).dot(H.T), jacobian=lambda _: H)


def _whitener(covariance: Floats) -> Floats:
    """L^-1 of a covariance L L^T: what it is the covariance of has that of ones then."""
    L = cholesky(covariance, lower=True)
    whitener: Floats = solve_triangular(L, np.eye(len(L)), lower=True)
    return whitener
