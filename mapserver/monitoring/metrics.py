"""The server in numbers, as Prometheus reads them: which there are, and its text format (version 0.0.4). Pure.

Names follow https://prometheus.io/docs/practices/naming/: base units, `_total` for what only grows until a restart.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
_NAME = re.compile(r"[a-z][a-z0-9_]*")
_REFUSED, _REFUSED_QUERY = "refused_", "refused_query_"
_KINDS = ("gauge", "counter")
Row = tuple[Mapping[str, str], float]


@dataclass(frozen=True)
class Metric:
    """One name with its rows: labels and a value each."""

    name: str
    kind: str
    help: str
    rows: tuple[Row, ...]

    def __post_init__(self) -> None:
        if not _NAME.fullmatch(self.name) or self.kind not in _KINDS:
            raise ValueError(f"metric {self.name!r} of kind {self.kind!r}")


@dataclass(frozen=True)
class Heard:
    """The newest health of one agent: its values (docs/protocol.md), and the server's clock when it came in."""

    values: Mapping[str, Any]
    heard_s: float


@dataclass(frozen=True)
class Host:
    """What this process takes of its host. turn_s: how long a reader had to wait for the store's owner just now."""

    resident_bytes: int
    cpu_s: float
    started_s: float
    store_bytes: int
    free_bytes: int
    turn_s: float


def render(metrics: Iterable[Metric]) -> str:
    """The exposition; metrics without rows are left out."""
    return "".join(_block(metric) for metric in metrics if metric.rows)


def metrics_of(info: Mapping[str, Any], agents: Mapping[str, Heard], host: Host, version: str) -> list[Metric]:
    """Everything that a server tells of itself.

    info: as `map/info` answers. agents: by machine.
    """
    return [*_of_server(info, version), *_of_machines(info), *_of_agents(agents), *_of_host(host)]


def _of_server(info: Mapping[str, Any], version: str) -> list[Metric]:
    counters: Mapping[str, int] = info["counters"]
    queries = _without(counters, _REFUSED_QUERY)
    batches = {k: v for k, v in _without(counters, _REFUSED).items() if not k.startswith("query_")}
    labels = {"site": str(info["site"]["name"]), "version": version}
    return [
        _gauge("sitegrid_info", "Site and version of the server.", [(labels, 1)]),
        _counter("sitegrid_batches_total", "Batches with new samples that were taken.", counters.get("batches", 0)),
        _counter("sitegrid_batches_refused_total", "Batches that were refused.", _labelled("reason", batches)),
        _counter("sitegrid_queries_refused_total", "Map queries that were refused.", _labelled("reason", queries)),
        _counter(
            "sitegrid_samples_trimmed_total",
            "Samples that came in once more, and were left out.",
            counters.get("samples_trimmed", 0),
        ),
        _gauge("sitegrid_journal_rows", "The last row of the journal on disk.", info["journalled"]),
        _gauge("sitegrid_merged_rows", "The last row of the journal that is in the map.", info["merged"]),
        _gauge("sitegrid_snapshot_rows", "The row that the newest snapshot is true for.", info["snapshot"]),
        _gauge("sitegrid_map_samples", "Samples that are in the map.", info["samples_merged"]),
        _gauge("sitegrid_map_samples_too_unsure", "Samples whose place is too unsure.", info["samples_too_unsure"]),
        _gauge("sitegrid_map_cells", "Cells that are known.", info["cells"]),
        _gauge("sitegrid_map_newest_timestamp_seconds", "Newest stamp of all samples.", info["stamp_ns"] / 1e9),
        *_of_writer(info.get("writer", {})),
    ]


def _of_writer(writer: Mapping[str, Any]) -> list[Metric]:
    """The thread that owns the store, where the server tells of it."""
    return [
        _gauge("sitegrid_waiting_batches", "Batches that wait to be taken.", _only(writer, "waiting")),
        _counter("sitegrid_commits_total", "Commits of the journal.", _only(writer, "commits")),
        _counter("sitegrid_commit_seconds_total", "Time spent on commits.", _only(writer, "commit_s")),
    ]


def _of_machines(info: Mapping[str, Any]) -> list[Metric]:
    machines: Mapping[str, Mapping[str, int]] = info["machines"]

    def of(field: str, factor: float = 1.0) -> list[Row]:
        return _labelled("machine", {name: entry[field] * factor for name, entry in machines.items()})

    trusted = {name: name not in info["distrusted"] for name in machines}
    return [
        _counter("sitegrid_machine_samples_total", "Samples of a machine that were taken.", of("samples")),
        _counter("sitegrid_machine_samples_lost_total", "Samples that it declared lost.", of("lost")),
        _gauge("sitegrid_machine_newest_timestamp_seconds", "Its newest stamp.", of("newest_ns", 1e-9)),
        _gauge("sitegrid_machine_trusted", "Whether its samples are in the map.", _labelled("machine", trusted)),
    ]


def _of_agents(agents: Mapping[str, Heard]) -> list[Metric]:
    def of(part: str, field: str) -> list[Row]:
        found = {name: _number(heard.values, part, field) for name, heard in agents.items()}
        return _labelled("machine", {name: value for name, value in found.items() if value is not None})

    heard_s = {name: heard.heard_s for name, heard in agents.items()}
    return [
        _gauge("sitegrid_agent_heard_timestamp_seconds", "When its health came in.", _labelled("machine", heard_s)),
        _gauge("sitegrid_agent_spool_samples", "Samples in its spool.", of("spool", "depth")),
        _gauge("sitegrid_agent_unsaved_samples", "Samples its disk has not taken.", of("spool", "unsaved")),
        _counter("sitegrid_agent_samples_recorded_total", "Samples in its spool ever.", of("spool", "recorded")),
        _counter("sitegrid_agent_samples_dropped_total", "Samples a full spool dropped.", of("spool", "dropped")),
        _counter("sitegrid_agent_samples_aside_total", "Samples the server never takes.", of("spool", "put_aside")),
        _gauge("sitegrid_agent_problem", "Whether something is wrong with a part of it.", _problems(agents)),
    ]


def _of_host(host: Host) -> list[Metric]:
    return [
        _gauge("sitegrid_turn_seconds", "Time that a reader just waited for the store.", host.turn_s),
        _gauge("sitegrid_store_bytes", "Size of the files of the store.", host.store_bytes),
        _gauge("sitegrid_store_free_bytes", "Free space of the disk that it lies on.", host.free_bytes),
        _gauge("process_resident_memory_bytes", "Resident memory of this process.", host.resident_bytes),
        _counter("process_cpu_seconds_total", "Processor time of this process.", host.cpu_s),
        _gauge("process_start_time_seconds", "Start of this process, since 1970.", host.started_s),
    ]


def _problems(agents: Mapping[str, Heard]) -> list[Row]:
    """1 where an agent says what is wrong, 0 where it says that nothing is."""
    rows: list[Row] = []
    for name, heard in sorted(agents.items()):
        uplink = heard.values.get("uplink")
        parts = {
            "uplink": uplink.get("problem") if isinstance(uplink, Mapping) else None,
            "spool": heard.values.get("spool_problem"),
            "calibration": heard.values.get("calibration_problem"),
        }
        rows += [({"machine": name, "part": part}, float(bool(p))) for part, p in parts.items() if p is not None]
    return rows


# --- rows ------------------------------------------------------------------------------------------------------------


def _gauge(name: str, what: str, rows: float | Sequence[Row]) -> Metric:
    return Metric(name, "gauge", what, _rows(rows))


def _counter(name: str, what: str, rows: float | Sequence[Row]) -> Metric:
    return Metric(name, "counter", what, _rows(rows))


def _rows(rows: float | Sequence[Row]) -> tuple[Row, ...]:
    return (({}, float(rows)),) if isinstance(rows, int | float) else tuple(rows)


def _labelled(label: str, values: Mapping[str, float]) -> list[Row]:
    return [({label: name}, float(value)) for name, value in sorted(values.items())]


def _without(counters: Mapping[str, int], prefix: str) -> dict[str, int]:
    return {name.removeprefix(prefix): value for name, value in counters.items() if name.startswith(prefix)}


def _only(table: Mapping[str, Any], field: str) -> list[Row]:
    return [({}, float(table[field]))] if field in table else []


def _number(values: Mapping[str, Any], part: str, field: str) -> float | None:
    """A number from what an agent sent, which may be anything."""
    table = values.get(part)
    value = table.get(field) if isinstance(table, Mapping) else None
    return float(value) if isinstance(value, int | float) else None


# --- text ------------------------------------------------------------------------------------------------------------


def _block(metric: Metric) -> str:
    what = metric.help.replace("\\", r"\\").replace("\n", r"\n")
    head = f"# HELP {metric.name} {what}\n# TYPE {metric.name} {metric.kind}\n"
    return head + "".join(f"{metric.name}{_labels(labels)} {_value(value)}\n" for labels, value in metric.rows)


def _labels(labels: Mapping[str, str]) -> str:
    return "{" + ",".join(f'{name}="{_escaped(text)}"' for name, text in labels.items()) + "}" if labels else ""


def _escaped(text: str) -> str:
    return text.replace("\\", r"\\").replace("\n", r"\n").replace('"', r"\"")


def _value(value: float) -> str:
    if math.isnan(value):
        return "NaN"
    if math.isinf(value):
        return "+Inf" if value > 0 else "-Inf"
    return repr(int(value)) if value == int(value) and abs(value) < 2**53 else repr(value)
