"""Publish simulated readings over Zenoh, one bundle per machine and span, at a multiple of real time."""

from __future__ import annotations

import contextlib
import itertools
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from protocol.errors import LinkError
from protocol.wire.bundle_stream import BundleStream, StreamClock
from protocol.wire.session import SessionConfig, open_session
from sim.can.live import Buses
from sim.config import SimConfig
from sim.receivers.ports import Ports
from sim.receivers.receiver import wire
from sim.recorder import write_truth
from sim.simulator import Simulator

PROGRESS_S = 0.2
WAIT_S = 30.0  # timeout for subscribers: agents started by hand


@dataclass(frozen=True)
class SimReport:
    """Summary of a run. bundles: per machine, without the closing one. late_s: largest lag."""

    machines: int
    simulated_s: float
    wall_s: float
    bundles: int
    readings: int
    late_s: float
    stopped: bool


def run(
    config: SimConfig,
    session_config: SessionConfig,
    stop: threading.Event,
    *,
    clock: Callable[[], float] = time.monotonic,
    on_progress: Callable[[float], None] | None = None,
    truth_dir: Path | None = None,
    ports_dir: Path | None = None,
    wait_s: float = WAIT_S,
) -> SimReport:
    """Simulate and publish until `config.seconds` have passed or `stop` is set; the truth is always written at the end.

    First waits up to wait_s for a subscriber of every machine, else LinkError; not if ports_dir, the folder of the
    receivers' ports, is given. on_progress gets the simulated time about five times a second.
    """
    with contextlib.ExitStack() as opened:
        simulator = opened.enter_context(contextlib.closing(Simulator(config)))
        streams = opened.enter_context(_streams(simulator, session_config))
        ports = opened.enter_context(contextlib.closing(_ports(simulator, ports_dir))) if ports_dir else None
        buses = opened.enter_context(contextlib.closing(_buses(simulator))) if simulator.config.can else None
        progress = throttled(on_progress, clock) if on_progress else None
        if not ports and (missing := _await_subscribers(streams, wait_s, stop, clock)):
            problem = f"nobody listens to machine {missing[0]} of site {simulator.site.name}"
            advice = f"start its agent with `sitegrid agent`, within {wait_s:g} s"
            raise LinkError(session_config.endpoint, f"{problem}: {advice}")
        try:
            report = _drive(simulator, streams, ports, stop, clock, progress, buses)
        finally:
            if truth_dir:
                write_truth(truth_dir, simulator)
    return report


def _drive(
    simulator: Simulator,
    streams: list[BundleStream],
    ports: Ports | None,
    stop: threading.Event,
    clock: Callable[[], float],
    progress: Callable[[float], None] | None,
    buses: Buses | None,
) -> SimReport:
    start, bundles, readings = clock(), 0, 0
    pace = StreamClock(simulator.config.speed, stop, clock)
    planned = simulator.bundles
    for _ in itertools.count() if planned is None else range(planned):
        if stop.is_set():
            break
        step = simulator.advance()
        pace.wait(simulator.simulated_s)  # a bundle is due at the end of its span
        for stream in streams:
            sensed = step[stream.machine]
            if buses:
                buses.send(stream.machine, simulator.frames[stream.machine])
                on_bus = simulator.buses[stream.machine].sensors
                sensed = [reading for reading in sensed if reading.sensor not in on_bus]
            stream.put(ports.send(stream.machine, sensed) if ports else tuple(sensed))
        bundles += 1
        readings += sum(map(len, step.values()))
        if progress:
            progress(simulator.simulated_s)
    wall_s = clock() - start
    stopped = planned is None or bundles < planned
    return SimReport(len(simulator.machines), simulator.simulated_s, wall_s, bundles, readings, pace.late_s, stopped)


def _ports(simulator: Simulator, folder: Path) -> Ports:
    format_ = simulator.config.receivers
    return Ports(folder, {rig.machine.name: wire(rig, format_) for rig in simulator.scenario.rigs()})


def _buses(simulator: Simulator) -> Buses:
    return Buses(simulator.config.can, simulator.buses)


@contextlib.contextmanager
def _streams(simulator: Simulator, session_config: SessionConfig) -> Iterator[list[BundleStream]]:
    session: Any = open_session(session_config)
    with contextlib.closing(session), contextlib.ExitStack() as closing:
        streams = [BundleStream(session, simulator.site.name, machine.name) for machine in simulator.machines]
        for stream in streams:
            closing.callback(stream.close)
        yield streams


def _await_subscribers(
    streams: list[BundleStream], wait_s: float, stop: threading.Event, clock: Callable[[], float]
) -> list[str]:
    """Wait for subscribers or `stop`; returns the machines without one."""
    deadline = clock() + wait_s
    while (missing := [s.machine for s in streams if not s.has_subscriber]) and not stop.is_set():
        if clock() >= deadline:
            return missing
        stop.wait(0.05)
    return []


def throttled(call: Callable[[float], None], clock: Callable[[], float]) -> Callable[[float], None]:
    """Limit calls to one per PROGRESS_S."""
    last = clock() - PROGRESS_S

    def now_and_then(simulated_s: float) -> None:
        nonlocal last
        if clock() - last >= PROGRESS_S:
            last = clock()
            call(simulated_s)

    return now_and_then
