"""Microseconds per filter step, ours and stock filterpy; cost of the smoother and a whole agent.

Stock runs twice: plain, wrong where angles wrap at +-pi, and with its optional angle functions. The agent's pure core
runs in a process of its own that imports an agent only: `python -m lab.agent SECONDS`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np
from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

from agents.localisation.filters.belief import Belief, Filter, Measurement
from agents.localisation.filters.ekf import Ekf
from agents.localisation.filters.motion import MotionModel, motion
from agents.localisation.filters.square_root import definite
from agents.localisation.filters.state import ATTITUDE, POSITION, RATE, VELOCITY, Layout
from agents.localisation.filters.ukf import Ukf
from agents.localisation.localiser import LocalisationConfig
from agents.positioning import PipelineConfig, Positioning
from lab import agent
from lab.speed.measure import Figures, in_child, in_turn, rows_of, timed
from protocol.arrays import Floats
from protocol.machine.readings import Reading
from sitegrid.proof.figures import Row

OPTIONS = {"runs": 5, "steps": 1000}
GOALS: dict[tuple[str, str], str] = {}
LAYOUT = Layout()  # 15 states
MODEL = MotionModel(LAYOUT)
DT_S = 0.01
SMOOTHER_S, AGENT_S = 150, 60  # drive lengths; the smoother's window is full for the last minute
LAGS_S = (0.0, 90.0)
MEASURED = {"update position": slice(POSITION.start, POSITION.start + 2), "update rate": RATE}
STOCK, ANGULAR = "stock ukf", "stock ukf, angles"
FilterStep = Callable[[], object]


def run(steps: int, runs: int) -> Iterator[Row]:
    """Every step of every filter, `steps` times per run; smoother and agent in percent of a core.

    times_stock, times_stock_angles: speed-up over filterpy.
    """
    filters = {STOCK: _stock({}), ANGULAR: _stock(ANGLE_SAFE), "ukf": _own(Ukf()), "ekf": _own(Ekf())}
    works = {f"{name}, {step}": work for name, made in filters.items() for step, work in made.items()}
    for work in works.values():
        work()  # one-time set-up
    took = in_turn({name: partial(_repeated, work, steps) for name, work in works.items()}, runs)
    for name, figures in took.items():
        step = name.rpartition(", ")[2]
        stock, angular = (took[f"{other}, {step}"]["wall_s"] / figures["wall_s"] for other in (STOCK, ANGULAR))
        us = figures["wall_s"] / steps * 1e6
        yield from rows_of(name, {"us": us, "times_stock": stock, "times_stock_angles": angular})
    fed = list(agent.bundles(SMOOTHER_S))
    lags = {f"{name}, {lag_s:g}": partial(_smoothed, fed, name, lag_s) for name in ("ekf", "ukf") for lag_s in LAGS_S}
    cost = in_turn(lags, runs)
    for name in ("ekf", "ukf"):
        without, with_it = (100 * cost[f"{name}, {lag_s:g}"]["cpu_s"] / SMOOTHER_S for lag_s in LAGS_S)
        yield from rows_of(f"{name} and smoother", {"cpu_percent": with_it, "smoother_percent": with_it - without})
    whole = in_turn({"agent": partial(in_child, "lab.agent", str(AGENT_S))}, runs)
    yield from rows_of("agent", whole["agent"])


def _repeated(work: FilterStep, steps: int) -> Figures:
    def repeat() -> None:
        for _ in range(steps):
            work()

    return timed(repeat)


def _smoothed(fed: Sequence[Sequence[Reading]], name: str, lag_s: float) -> Figures:
    """A whole drive with a filter and smoother lag."""
    config = PipelineConfig(localisation=LocalisationConfig(filter=name, lag_s=lag_s))
    positioning = Positioning(agent.SITE, agent.machine(), config)

    def work() -> None:
        for readings in fed:
            positioning.step(readings)

    return timed(work)


def _start() -> Belief:
    """Well-measured machine at 3 m/s on a bumpy road."""
    x = np.zeros(LAYOUT.n)
    x[ATTITUDE], x[VELOCITY], x[RATE] = (0.05, -0.1, 0.7), (3.0, 0.1, 0.0), (0.02, 0.01, 0.3)
    return definite(0, x, np.diag(np.linspace(0.02, 0.5, LAYOUT.n)))  # with its factor, like a filter's result


def _own(kind: Filter) -> dict[str, FilterStep]:
    """An agent's work per step, including motion and measurement.

    As in a drive, a step finds its belief's covariance factor and computes the next one's.
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
    """Filterpy as documented: Python functions of one state."""
    points = MerweScaledSigmaPoints(LAYOUT.n, alpha=0.5, beta=2.0, kappa=0.0)
    start = _start()
    ukf = UnscentedKalmanFilter(LAYOUT.n, 2, DT_S, hx=None, fx=_stock_motion, points=points, **options)
    ukf.Q = motion(MODEL, start, DT_S).Q
    ukf.x, ukf.P = start.x, start.P
    ukf.predict()  # draws the sigma points for updates

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
    y: Floats = a - b
    y[ATTITUDE] = (y[ATTITUDE] + math.pi) % (2 * math.pi) - math.pi
    return y


def _stock_mean(sigmas: Floats, weights: Floats) -> Floats:
    """Mean of states; angles by sine and cosine."""
    x: Floats = weights @ sigmas
    x[ATTITUDE] = np.arctan2(weights @ np.sin(sigmas[:, ATTITUDE]), weights @ np.cos(sigmas[:, ATTITUDE]))
    return x


# Functions that filterpy needs across +-pi, by its author's book; our filters do the same.
ANGLE_SAFE = {"residual_x": _stock_residual, "x_mean_fn": _stock_mean}


def _stock_motion(x: Floats, dt: float) -> Floats:
    """The same motion for one state; scalars are faster than arrays of three."""
    px, py, pz, roll, pitch, yaw, vx, vy, vz, p, q, r, ax, ay, az = x.tolist()
    cr, sr, cp, sp, cy, sy = (f(a) for a in (roll, pitch, yaw) for f in (math.cos, math.sin))
    forward, left, up = (v * dt + a * dt * dt / 2 for v, a in ((vx, ax), (vy, ay), (vz, az)))
    left, up = cr * left - sr * up, sr * left + cr * up
    forward, up = cp * forward + sp * up, cp * up - sp * forward
    turn = (sr * q + cr * r) * dt / cp
    place = px + cy * forward - sy * left, py + sy * forward + cy * left, pz + up
    attitude = roll + p * dt + sp * turn, pitch + (cr * q - sr * r) * dt, yaw + turn
    return np.array([*place, *attitude, vx + ax * dt, vy + ay * dt, vz + az * dt, p, q, r, ax, ay, az])
