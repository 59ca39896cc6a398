"""Metrics of the server, collected on each request of Prometheus, and its agents' health.

Names follow https://prometheus.io/docs/practices/naming/: base units, `_total` for counters.
"""

from __future__ import annotations

import shutil
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import zenoh
from prometheus_client import Metric
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, InfoMetricFamily
from prometheus_client.registry import Collector

from protocol.errors import ConfigError, MessageError
from protocol.queries.answers import GroundChange
from protocol.wire import keys
from protocol.wire.codec import decode_health
from protocol.wire.fields import MAX_SMALL_BYTES
from protocol.wire.latest_values import LatestValues

_REFUSED, _REFUSED_QUERY = "refused_", "refused_query_"
Family = GaugeMetricFamily | CounterMetricFamily
Values = float | Mapping[str, float]  # one value, or values by label


@dataclass(frozen=True)
class ReceivedHealth:
    """An agent's newest health, and server time of reception [s since 1970]."""

    values: Mapping[str, Any]
    received_s: float


class HealthListener:
    """Keeps each agent's newest health as bytes until needed: callbacks only move bytes."""

    def __init__(self, session: zenoh.Session, site: str, clock: Callable[[], float] = time.time) -> None:
        self._newest: LatestValues[bytes] = LatestValues(clock)
        self._subscriber = session.declare_subscriber(keys.health_all(site), self._on_health)

    def received(self) -> dict[str, ReceivedHealth]:
        """Valid health by machine, if it came under the machine's own key."""
        readable = {}
        for name, data, received_s in sorted(self._newest.items()):
            try:
                health = decode_health(data)
            except MessageError:
                continue
            if health.machine == name:
                readable[name] = ReceivedHealth(health.values, received_s)
        return readable

    def close(self) -> None:
        """Stop listening."""
        self._subscriber.undeclare()  # type: ignore[no-untyped-call]

    def _on_health(self, sample: zenoh.Sample) -> None:
        try:
            machine = keys.machine_of(str(sample.key_expr))
        except ConfigError:  # a wildcard names no machine
            return
        data = sample.payload.to_bytes()
        if len(data) <= MAX_SMALL_BYTES:
            self._newest.hear(machine, data)


class ServerCollector(Collector):
    """All metrics of a server, except those of its process.

    info: as `map/info`, from the store's thread. agents: health by machine. changes: of the ground, so far.
    """

    def __init__(
        self,
        info: Callable[[], Mapping[str, Any]],
        agents: Callable[[], Mapping[str, ReceivedHealth]],
        changes: Callable[[], Iterable[GroundChange]],
        store: Path,
        version: str,
    ) -> None:
        self._info, self._agents, self._changes, self._store, self._version = info, agents, changes, store, version

    def describe(self) -> Iterable[Metric]:
        """Empty, so that registering does not query the server."""
        return []

    def collect(self) -> Iterable[Metric]:
        """All metrics."""
        start_s = time.perf_counter()
        info = self._info()
        turn_s = time.perf_counter() - start_s
        labels = {"site": str(info["site"]["name"]), "version": self._version}
        yield InfoMetricFamily("sitegrid", "Site and version of the server.", labels)
        yield from _server(info)
        yield from _machines(info)
        yield from _agent_health(self._agents())
        became = Counter(dict.fromkeys(("better", "worse", "unclear"), 0))
        became.update(map(_became, self._changes()))
        yield _counter("sitegrid_ground_changes_total", "Changes of the ground.", became, "became")
        yield _gauge("sitegrid_turn_seconds", "Time that a reader just waited for the store.", turn_s)
        yield _gauge("sitegrid_store_bytes", "Size of the files of the store.", size_of(self._store))
        free_bytes = shutil.disk_usage(self._store).free
        yield _gauge("sitegrid_store_free_bytes", "Free space of the disk that it lies on.", free_bytes)


def size_of(folder: Path) -> int:
    """Bytes of all files in a folder."""
    return sum(_size(path) for path in folder.rglob("*"))


def _size(path: Path) -> int:
    try:
        return path.stat().st_size if path.is_file() else 0
    except OSError:  # deleted meanwhile
        return 0


def _server(info: Mapping[str, Any]) -> Iterable[Metric]:
    counters, writer = info["counters"], info["writer"]
    queries = _without(counters, _REFUSED_QUERY)
    batches = {k: v for k, v in _without(counters, _REFUSED).items() if not k.startswith("query_")}
    trimmed, past = counters.get("samples_trimmed", 0), info["checkpoints"]
    answered, made = (counters.get(name, 0) for name in ("queries_answered", "roads_made"))
    return [
        _counter("sitegrid_batches_total", "Batches with new samples that were taken.", counters.get("batches", 0)),
        _counter("sitegrid_batches_refused_total", "Batches that were refused.", batches, "reason"),
        _counter("sitegrid_queries_refused_total", "Map queries that were refused.", queries, "reason"),
        _counter("sitegrid_queries_answered_total", "Map queries that were answered.", answered),
        _counter(
            "sitegrid_layers_total", "Blocks and squares whose layers a query needed.", _layers(counters), "source"
        ),
        _counter("sitegrid_roads_made_total", "Road maps that were made of the map as it is.", made),
        _counter("sitegrid_roads_made_seconds_total", "Time spent on that.", counters.get("roads_made_ms", 0) / 1e3),
        _counter("sitegrid_samples_trimmed_total", "Samples that came in once more, and do not count.", trimmed),
        _gauge("sitegrid_journal_rows", "The last row of the journal on disk.", info["journalled"]),
        _gauge("sitegrid_merged_rows", "The last row of the journal that is in the map.", info["merged"]),
        _gauge("sitegrid_snapshot_rows", "The row that the newest snapshot is true for.", info["snapshot"]),
        _gauge("sitegrid_checkpoints", "Checkpoints that maps of the past can begin with.", past["count"]),
        _gauge("sitegrid_checkpoint_bytes", "Size of all checkpoints.", past["bytes"]),
        _gauge("sitegrid_checkpoint_newest_timestamp_seconds", "Until when the newest goes.", past["newest_ns"] / 1e9),
        _counter("sitegrid_checkpoints_passed_over_total", "Damaged ones; they are made again.", past["passed_over"]),
        _gauge("sitegrid_map_samples", "Samples that are in the map.", info["samples_merged"]),
        _gauge("sitegrid_map_samples_too_unsure", "Samples of too uncertain a position.", info["samples_too_unsure"]),
        _gauge("sitegrid_map_cells", "Cells that are known.", info["cells"]),
        _gauge("sitegrid_map_newest_timestamp_seconds", "Newest stamp of trusted machines.", info["stamp_ns"] / 1e9),
        _gauge("sitegrid_map_ahead_seconds", "How far that is ahead of the server's clock.", _ahead_s(info)),
        _gauge("sitegrid_shortfalls", "Times that acknowledged samples were gone.", len(info["shortfalls"])),
        _gauge("sitegrid_waiting_batches", "Batches that wait to be taken.", writer["waiting"]),
        _gauge("sitegrid_waiting_bytes", "What these batches take in memory.", writer["waiting_bytes"]),
        _counter("sitegrid_commits_total", "Commits of the journal.", writer["commits"]),
        _counter("sitegrid_commit_seconds_total", "Time spent on commits.", writer["commit_s"]),
    ]


def _became(change: GroundChange) -> str:
    """By resistance."""
    before, after = change.resistance_before, change.resistance_after
    return "unclear" if before is None or after is None else "better" if after < before else "worse"


def _ahead_s(info: Mapping[str, Any]) -> float:
    """Negative for an idle site or replayed log; 0 before any sample."""
    return (info["stamp_ns"] - info["wall_ns"]) / 1e9 if info["stamp_ns"] else 0.0


def _machines(info: Mapping[str, Any]) -> Iterable[Metric]:
    machines: Mapping[str, Mapping[str, int]] = info["machines"]

    def by_machine(field: str, factor: float = 1.0) -> Values:
        return {name: entry[field] * factor for name, entry in machines.items()}

    trusted = {name: name not in info["distrusted"] for name in machines}
    return [
        _counter("sitegrid_machine_samples_total", "Samples of a machine that were taken.", by_machine("samples")),
        _counter("sitegrid_machine_samples_lost_total", "Samples that it declared lost.", by_machine("lost")),
        _gauge("sitegrid_machine_samples_missing", "Acknowledged samples that are gone.", by_machine("missing")),
        _gauge("sitegrid_machine_newest_timestamp_seconds", "Its newest stamp.", by_machine("newest_ns", 1e-9)),
        _gauge("sitegrid_machine_trusted", "Whether its samples are in the map.", trusted),
    ]


def _agent_health(agents: Mapping[str, ReceivedHealth]) -> Iterable[Metric]:
    def of_spool(field: str) -> Values:
        numbers = {name: _number(health.values, "spool", field) for name, health in agents.items()}
        return {name: number for name, number in numbers.items() if number is not None}

    received_s = {name: health.received_s for name, health in agents.items()}
    return [
        _gauge("sitegrid_agent_heard_timestamp_seconds", "When its health came in.", received_s),
        _gauge("sitegrid_agent_spool_samples", "Samples in its spool.", of_spool("depth")),
        _gauge("sitegrid_agent_pending_samples", "Those that wait for the smoother.", of_spool("pending")),
        _gauge("sitegrid_agent_unsaved_samples", "Samples its disk has not taken.", of_spool("unsaved")),
        _counter("sitegrid_agent_samples_recorded_total", "Samples in its spool ever.", of_spool("recorded")),
        _counter("sitegrid_agent_samples_dropped_total", "Samples a full spool dropped.", of_spool("dropped")),
        _counter("sitegrid_agent_samples_gone_total", "Samples that its disk has lost.", of_spool("gone")),
        _counter("sitegrid_agent_samples_aside_total", "Samples the server never takes.", of_spool("put_aside")),
        _problems(agents),
    ]


def _problems(agents: Mapping[str, ReceivedHealth]) -> Metric:
    """1 where an agent reports a problem, 0 where it reports none."""
    metric = GaugeMetricFamily(
        "sitegrid_agent_problem", "Whether something is wrong with a part of it.", labels=["machine", "part"]
    )
    for name, health in sorted(agents.items()):
        tables = {name: health.values.get(name) for name in ("uplink", "corrections")}
        parts = {
            **{part: table.get("problem") for part, table in tables.items() if isinstance(table, Mapping)},
            "receivers": health.values.get("driver_problems"),
            "clocks": health.values.get("clocks"),
            "spool": health.values.get("spool_problem"),
            "disk": health.values.get("spool_damage"),
            "calibration": health.values.get("calibration_problem"),
        }
        for part, problem in parts.items():
            if problem is not None:
                metric.add_metric([name, part], float(bool(problem)))
    return metric


def _filled(family: type[Family], name: str, what: str, values: Values, label: str = "machine") -> Metric:
    if not isinstance(values, Mapping):
        return family(name, what, value=values)
    metric = family(name, what, labels=[label])
    for text, value in sorted(values.items()):
        metric.add_metric([text], value)
    return metric


_gauge, _counter = partial(_filled, GaugeMetricFamily), partial(_filled, CounterMetricFamily)


def _layers(counters: Mapping[str, int]) -> dict[str, int]:
    """Layers from the cache, and derived ones."""
    return {source: counters.get(f"layers_{source}", 0) for source in ("kept", "derived")}


def _without(counters: Mapping[str, int], prefix: str) -> dict[str, int]:
    return {name.removeprefix(prefix): value for name, value in counters.items() if name.startswith(prefix)}


def _number(values: Mapping[str, Any], part: str, field: str) -> float | None:
    """A number from an agent's data, which may be anything."""
    table = values.get(part)
    value = table.get(field) if isinstance(table, Mapping) else None
    return float(value) if isinstance(value, int | float) else None
