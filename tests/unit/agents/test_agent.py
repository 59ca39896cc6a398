"""An agent's samples: pending at once, final later, none pending for ever."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agents.agent import EVERY_S, SILENT_S, Agent, Places
from agents.config import AgentConfig
from agents.delivery.spool import Spool, SpoolConfig
from agents.localisation.localiser import LocalisationConfig
from agents.pipeline import Pipeline
from agents.positioning import PipelineConfig
from agents.sampling import LAG_S
from protocol.machine.readings import Reading
from protocol.wire.session import SessionConfig, free_endpoint, open_session
from tests.unit.agents.drives import S_BEND, SITE, START, VEHICLE, drive, thinned

READ_S = 0.2
LAG = 4.0
CONFIG = PipelineConfig(LocalisationConfig("ekf", lag_s=LAG, start=START))
READINGS = thinned(drive(S_BEND, VEHICLE).readings)


class Stream:
    """Real-time readings, then silence; owns the clock and counts the spooled samples."""

    def __init__(self, readings: Sequence[Reading], silent_s: float = 0.0, after: Sequence[Reading] = ()) -> None:
        self.now_s = 50.0
        self.seen: list[dict[str, int]] = []
        self.agent: Agent | None = None
        self.silent = self._cut(readings), round(silent_s / READ_S), self._cut(after)
        self._spans = self._all()

    def read(self, timeout_s: float) -> Sequence[Reading] | None:
        assert self.agent
        self.seen.append(self.agent._spool.counters())
        self.now_s += READ_S
        return next(self._spans, None)

    def counters(self) -> dict[str, int]:
        return {}

    def problems(self) -> list[str]:
        return []

    def close(self) -> None:
        return

    def wait(self, seconds: float) -> None:
        self.now_s += seconds

    def _all(self) -> Iterator[list[Reading]]:
        first, n, after = self.silent
        yield from first
        yield from ([] for _ in range(n))
        yield from after

    def _cut(self, readings: Sequence[Reading]) -> list[list[Reading]]:
        spans: dict[int, list[Reading]] = {}
        for r in readings:
            spans.setdefault(int(r.stamp_ns / (READ_S * 1e9)), []).append(r)
        return list(spans.values())


@pytest.fixture(scope="module")
def session() -> Iterator[Any]:
    session: Any = open_session(SessionConfig(free_endpoint(), mode="router"))
    yield session
    session.close()


def run(session: Any, folder: Path, stream: Stream, *, config: PipelineConfig = CONFIG, stop_s: float = 1e9) -> Any:
    """Report of an agent on the stream without map server; stop_s: time of a SIGTERM."""
    places = Places(folder / "spool.db", folder / "audit")
    agent = stream.agent = Agent(session, SITE, VEHICLE, AgentConfig(config, linger_s=0.0), places)
    try:
        return agent.run(stream, lambda: stream.now_s >= 50.0 + stop_s, lambda: stream.now_s, stream.wait)
    finally:
        agent.close()


def in_spool(folder: Path) -> np.ndarray:
    """All waiting samples, as the next agent would send them."""
    spool = Spool(folder / "spool.db", SpoolConfig())
    head = spool.head(10_000)
    spool.close()
    assert head is not None
    return head.rows


def by_pipeline(*spans: Sequence[Reading], config: PipelineConfig = CONFIG) -> list[np.ndarray]:
    """The pipeline's final samples; all spans but the last end in silence."""
    pipeline = Pipeline(SITE, VEHICLE, config)
    rows = []
    for span in spans[:-1]:
        rows += [pipeline.step(span).final, pipeline.settle().final]
    return [*rows, pipeline.step(spans[-1]).final, pipeline.finish().final]


@pytest.mark.slow
def test_what_is_sent_in_the_end_is_what_the_pipeline_calls_final(session: Any, tmp_path: Path) -> None:
    stream = Stream(READINGS)
    report = run(session, tmp_path, stream)
    rows = np.concatenate(by_pipeline(READINGS))
    assert in_spool(tmp_path).tobytes() == rows.tobytes()
    assert report["samples"] == report["spool"]["recorded"] == len(rows)
    assert report["spool"]["pending"] == 0
    pending = [seen["pending"] for seen in stream.seen[-100:]]
    a_second = 2.0 / 0.5  # samples at 2 m/s
    assert min(pending) > (LAG - LAG_S) * a_second
    assert max(pending) < (LAG + 3.0) * a_second
    depth = [seen["depth"] for seen in stream.seen]
    steps = np.flatnonzero(np.diff(depth))
    assert np.diff(steps).min() >= EVERY_S / READ_S, "written together once a second"


@pytest.mark.slow
def test_a_machine_that_is_parked_with_its_sensors_off_keeps_nothing_pending(session: Any, tmp_path: Path) -> None:
    stream = Stream(READINGS, silent_s=60.0)
    silent = len(stream.silent[0])
    run(session, tmp_path, stream)
    pending = [seen["pending"] for seen in stream.seen]
    last_s = READ_S * (np.flatnonzero(pending)[-1] - silent)
    assert SILENT_S - 1 < last_s < SILENT_S + EVERY_S + 1
    assert stream.seen[-1]["depth"] == stream.seen[-1]["recorded"] == len(in_spool(tmp_path))


@pytest.mark.slow
def test_after_a_silence_samples_go_on(session: Any, tmp_path: Path) -> None:
    """After a lost link or a pause: settled samples stay, none comes twice."""
    half = len(READINGS) // 2
    run(session, tmp_path, Stream(READINGS[:half], 15.0, READINGS[half:]))
    rows = in_spool(tmp_path)
    assert rows.tobytes() == np.concatenate(by_pipeline(READINGS[:half], READINGS[half:])).tobytes()
    assert (np.diff(rows["stamp_ns"]) > 0).all()
    assert len(rows) > 60


@pytest.mark.slow
def test_an_agent_that_is_asked_to_end_leaves_the_smoothed_places_of_all_samples(session: Any, tmp_path: Path) -> None:
    stream = Stream(READINGS)
    stop_s = READ_S * len(stream.silent[0]) * 0.7
    report = run(session, tmp_path, stream, stop_s=stop_s)
    assert (report["delivered"], report["spool"]["pending"]) == (False, 0)
    taken = [r for span in stream.silent[0][: len(stream.seen)] for r in span]
    assert in_spool(tmp_path).tobytes() == np.concatenate(by_pipeline(taken)).tobytes()
