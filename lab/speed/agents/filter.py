"""Microseconds per step of the filters, own and filterpy's stock one; what the smoother and a whole agent cost.

Stock comes twice: plain, which is wrong where angles cross +-pi, and with the functions for angles that it asks for.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

from agents.localisation.filters.belief import Belief, Filter, Measurement
from agents.localisation.filters.ekf import Ekf
from agents.localisation.filters.motion import MotionModel, motion
from agents.localisation.filters.square_root import definite
from agents.localisation.filters.state import ATTITUDE, POSITION, RATE, VELOCITY, Layout
from agents.localisation.filters.ukf import Ukf
from lab.speed.agents import agent, smoother
from lab.speed.measure import Report, machine, medians, timed
from protocol.arrays import Floats

LAYOUT = Layout()  # the 15 states
MODEL = MotionModel(LAYOUT)
DT_S = 0.01
MEASURED = {"update position": slice(POSITION.start, POSITION.start + 2), "update rate": RATE}
STOCK, ANGULAR = "stock ukf", "stock ukf, angles"
FilterStep = Callable[[], object]


def run(steps: int, runs: int) -> Report:
    """Measure each step of each filter; a run does it so many times, and the median of the runs counts."""
    variants = {STOCK: _stock({}), ANGULAR: _stock(ANGLE_SAFE), "ukf": _own(Ukf()), "ekf": _own(Ekf())}
    works = {(name, step): work for name, made in variants.items() for step, work in made.items()}
    for work in works.values():
        work()  # what is made once is made
    seconds = medians({f"{name}/{step}": _timer(work, steps) for (name, step), work in works.items()}, runs)
    rows = []
    for name, step in works:
        took_s = seconds[f"{name}/{step}"]
        stock, angular = (round(seconds[f"{other}/{step}"] / took_s, 1) for other in (STOCK, ANGULAR))
        us = round(took_s / steps * 1e6, 1)
        rows.append({"filter": name, "step": step, "us": us, "x_stock": stock, "x_stock_angles": angular})
    result = {"benchmark": "filter", "steps": steps, "runs": runs, **machine(), "rows": rows}
    return {**result, "smoother": smoother.measured(runs), "agent": [agent.measured(runs)]}


def _timer(work: FilterStep, steps: int) -> Callable[[], float]:
    def repeat() -> None:
        for _ in range(steps):
            work()

    return lambda: timed(repeat)


def _start() -> Belief:
    """A machine at 3 m/s on a bumpy road, known as well as one that is well measured."""
    x = np.zeros(LAYOUT.n)
    x[ATTITUDE], x[VELOCITY], x[RATE] = (0.05, -0.1, 0.7), (3.0, 0.1, 0.0), (0.02, 0.01, 0.3)
    return definite(0, x, np.diag(np.linspace(0.02, 0.5, LAYOUT.n)))  # with its factor, as a filter leaves it


def _own(kind: Filter) -> dict[str, FilterStep]:
    """What an agent does for each step, the making of the motion and of the measurement included.

    As in a drive a step finds the factor of its belief's covariance, and computes that of the belief it makes.
    """
    belief = _start()
    updates = {name: _conditioned(kind, belief, states) for name, states in MEASURED.items()}
    return {"predict": lambda: kind.predict(belief, motion(MODEL, belief, DT_S), 10_000_000), **updates}


def _conditioned(kind: Filter, belief: Belief, states: slice) -> FilterStep:
    z, H = belief.x[states] + 0.01, np.eye(LAYOUT.n)[states]
    R = np.eye(len(z)) * 0.1

    def work() -> object:
        measurement = Measurement("sensor", 0, z, R, lambda s: s[:, states], lambda _: H, gate_sigma=4.0)
        return kind.condition(belief, measurement)

    return work


def _stock(options: dict[str, Any]) -> dict[str, FilterStep]:
    """The filter as its documentation shows it: functions of one state, in Python."""
    points = MerweScaledSigmaPoints(LAYOUT.n, alpha=0.5, beta=2.0, kappa=0.0)
    start = _start()
    ukf = UnscentedKalmanFilter(LAYOUT.n, 2, DT_S, hx=None, fx=_stock_motion, points=points, **options)
    ukf.Q = motion(MODEL, start, DT_S).Q
    ukf.x, ukf.P = start.x, start.P
    ukf.predict()  # draws the sigma points that each update uses

    def predict() -> None:
        ukf.x, ukf.P = start.x, start.P
        ukf.Q = motion(MODEL, start, DT_S).Q
        ukf.predict()

    def updated(states: slice) -> FilterStep:
        z = start.x[states] + 0.01
        R = np.eye(len(z)) * 0.1

        def update() -> None:
            ukf.x, ukf.P = start.x, start.P
            ukf.update(z, R=R, hx=lambda x: x[states])

        return update

    return {"predict": predict, **{name: updated(states) for name, states in MEASURED.items()}}


def _stock_residual(a: Floats, b: Floats) -> Floats:
    """Difference of two states."""
    y: Floats = a - b
    y[ATTITUDE] = (y[ATTITUDE] + math.pi) % (2 * math.pi) - math.pi
    return y


def _stock_mean(sigmas: Floats, weights: Floats) -> Floats:
    """Mean of states, of angles by their sines and cosines."""
    x: Floats = weights @ sigmas
    x[ATTITUDE] = np.arctan2(weights @ np.sin(sigmas[:, ATTITUDE]), weights @ np.cos(sigmas[:, ATTITUDE]))
    return x


# What filterpy needs to be right across +-pi, as its author's book has it; own filters do the same.
ANGLE_SAFE = {"residual_x": _stock_residual, "x_mean_fn": _stock_mean}


def _stock_motion(x: Floats, dt: float) -> Floats:
    """The same motion, of one state; plain numbers are faster than arrays of three."""
    px, py, pz, roll, pitch, yaw, vx, vy, vz, p, q, r, ax, ay, az = x.tolist()
    cr, sr, cp, sp, cy, sy = (f(a) for a in (roll, pitch, yaw) for f in (math.cos, math.sin))
    forward, left, up = (v * dt + a * dt * dt / 2 for v, a in ((vx, ax), (vy, ay), (vz, az)))
    left, up = cr * left - sr * up, sr * left + cr * up
    forward, up = cp * forward + sp * up, cp * up - sp * forward
    turn = (sr * q + cr * r) * dt / cp
    place = px + cy * forward - sy * left, py + sy * forward + cy * left, pz + up
    attitude = roll + p * dt + sp * turn, pitch + (cr * q - sr * r) * dt, yaw + turn
    return np.array([*place, *attitude, vx + ax * dt, vy + ay * dt, vz + az * dt, p, q, r, ax, ay, az])
