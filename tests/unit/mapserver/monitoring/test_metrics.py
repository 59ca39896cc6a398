"""The server's metrics, read by the library's parser."""

from __future__ import annotations

import re
import socket
import time
import urllib.error
import urllib.request
from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pytest
from prometheus_client import CollectorRegistry, Metric, ProcessCollector, generate_latest
from prometheus_client.parser import text_string_to_metric_families
from prometheus_client.registry import Collector
from ruamel.yaml import YAML

from mapserver.monitoring.exporter import Exporter
from mapserver.monitoring.metrics import HealthListener, ReceivedHealth, ServerCollector
from protocol.errors import LinkError
from protocol.queries.answers import GroundChange
from protocol.wire import keys
from protocol.wire.codec import encode_health
from protocol.wire.fields import MAX_SMALL_BYTES
from protocol.wire.latest_values import MOST_NAMES
from protocol.wire.messages import Health
from tests.paths import ROOT
from tests.patience import until
from tests.unit.mapserver.data import NOW_NS, routed

Values = dict[tuple[str, frozenset[tuple[str, str]]], float]
INFO: dict[str, Any] = {
    "site": {"name": "pit"},
    "journalled": 12,
    "merged": 11,
    "snapshot": 5,
    "checkpoints": {"count": 12, "bytes": 9000, "newest_ns": 1_750_000_000_000_000_000, "passed_over": 1},
    "samples_merged": 300,
    "samples_too_unsure": 4,
    "cells": 250,
    "stamp_ns": NOW_NS,
    "wall_ns": NOW_NS - 3 * 10**9,
    "machines": {
        "loader-1": {"spools": 1, "samples": 200, "lost": 3, "newest_ns": NOW_NS, "missing": 5},
        "loader-2": {"spools": 2, "samples": 104, "lost": 0, "newest_ns": NOW_NS - 10**9, "missing": 0},
    },
    "distrusted": ["loader-2"],
    "shortfalls": ["5 acknowledged samples of loader-1 are gone"],
    "counters": {
        "batches": 12,
        "samples_trimmed": 7,
        "queries_answered": 5,
        "roads_made": 6,
        "roads_made_ms": 1500,
        "refused_gap": 2,
        "refused_query_unknown_layer": 1,
    },
    "writer": {"waiting": 3, "waiting_bytes": 4096, "commits": 20, "commit_s": 0.5},
}
CHANGES = [
    GroundChange(i, 1, 2, (0.0, 0.0, 1.0, 1.0), 4, before, after, None, None)
    for i, (before, after) in enumerate([(0.03, 0.02), (0.03, 0.05), (0.02, 0.03)], start=1)
]
HEALTH = {
    "spool": {"depth": 40, "pending": 30, "unsaved": 1, "recorded": 90, "dropped": 2, "put_aside": 1, "gone": 6},
    "uplink": {"problem": "no answer"},
    "spool_problem": "",
}


def exposition(folder: Path, info: Mapping[str, Any] = INFO, **health: Mapping[str, Any]) -> str:
    """Metrics text of a server in this state; health by machine, `_` for `-`."""
    received = {name.replace("_", "-"): ReceivedHealth(values, 1e9 + 0.25) for name, values in health.items()}
    registry = CollectorRegistry()
    registry.register(ServerCollector(lambda: info, lambda: received, lambda: CHANGES, folder, "1.2"))
    ProcessCollector(registry=registry)
    return generate_latest(registry).decode()


def read(text: str) -> Values:
    samples = [sample for family in text_string_to_metric_families(text) for sample in family.samples]
    values = {(sample.name, frozenset(sample.labels.items())): sample.value for sample in samples}
    assert len(values) == len(samples), "each stands there once"
    return values


def at(values: Values, name: str, **labels: str) -> float:
    return values[name, frozenset(labels.items())]


def test_the_state_of_the_server_is_exposed(tmp_path: Path):
    values = read(exposition(tmp_path))
    plain = {name.removeprefix("sitegrid_"): value for (name, labels), value in values.items() if not labels}
    assert plain.pop("turn_seconds") >= 0
    assert plain.pop("store_free_bytes") > 0
    assert 10 * 2**20 < plain.pop("process_resident_memory_bytes") < 2**34
    assert plain.pop("process_cpu_seconds_total") > 0
    assert 0 < time.time() - plain.pop("process_start_time_seconds") < 3600
    assert {name: value for name, value in plain.items() if not name.startswith("process")} == {
        "batches_total": 12,
        "samples_trimmed_total": 7,
        "queries_answered_total": 5,
        "journal_rows": 12,
        "merged_rows": 11,
        "snapshot_rows": 5,
        "checkpoints": 12,
        "checkpoint_bytes": 9000,
        "checkpoint_newest_timestamp_seconds": 1.75e9,
        "checkpoints_passed_over_total": 1,
        "map_samples": 300,
        "map_samples_too_unsure": 4,
        "map_cells": 250,
        "roads_made_total": 6,
        "roads_made_seconds_total": 1.5,
        "shortfalls": 1,
        "map_newest_timestamp_seconds": NOW_NS / 1e9,
        "map_ahead_seconds": 3,
        "waiting_batches": 3,
        "waiting_bytes": 4096,
        "commits_total": 20,
        "commit_seconds_total": 0.5,
        "store_bytes": 0,
    }
    assert at(values, "sitegrid_info", site="pit", version="1.2") == 1
    refused = {key: value for key, value in values.items() if "refused" in key[0]}
    assert refused == {
        ("sitegrid_batches_refused_total", frozenset({("reason", "gap")})): 2,
        ("sitegrid_queries_refused_total", frozenset({("reason", "unknown_layer")})): 1,
    }
    changes = {
        word: at(values, "sitegrid_ground_changes_total", became=word) for word in ("better", "worse", "unclear")
    }
    assert changes == {"better": 1, "worse": 2, "unclear": 0}
    assert at(values, "sitegrid_machine_samples_total", machine="loader-2") == 104
    assert at(values, "sitegrid_machine_samples_lost_total", machine="loader-1") == 3
    assert at(values, "sitegrid_machine_samples_missing", machine="loader-1") == 5
    newest_s = at(values, "sitegrid_machine_newest_timestamp_seconds", machine="loader-2")
    assert newest_s == pytest.approx(NOW_NS / 1e9 - 1)
    assert [at(values, "sitegrid_machine_trusted", machine=f"loader-{i}") for i in (1, 2)] == [1, 0]


def test_agents_are_exposed_as_they_describe_themselves(tmp_path: Path):
    values = read(exposition(tmp_path, loader_1=HEALTH))
    assert at(values, "sitegrid_agent_problem", machine="loader-1", part="uplink") == 1
    assert at(values, "sitegrid_agent_problem", machine="loader-1", part="spool") == 0
    damaged = read(exposition(tmp_path, loader_1={**HEALTH, "spool_damage": "spool.db-wal is damaged"}))
    assert at(damaged, "sitegrid_agent_problem", machine="loader-1", part="disk") == 1
    assert not [key for key in values if ("part", "calibration") in key[1]], "it said nothing of it"
    agent = {name: value for (name, labels), value in values.items() if "_agent_" in name and len(labels) == 1}
    assert agent == {
        "sitegrid_agent_heard_timestamp_seconds": 1e9 + 0.25,
        "sitegrid_agent_spool_samples": 40,
        "sitegrid_agent_pending_samples": 30,
        "sitegrid_agent_unsaved_samples": 1,
        "sitegrid_agent_samples_recorded_total": 90,
        "sitegrid_agent_samples_dropped_total": 2,
        "sitegrid_agent_samples_gone_total": 6,
        "sitegrid_agent_samples_aside_total": 1,
    }


@pytest.mark.parametrize("health", [{}, {"spool": 7, "uplink": "x"}, {"spool": {"depth": "many"}, "uplink": []}])
def test_whatever_an_agent_sends_the_rest_is_exposed(tmp_path: Path, health: dict[str, object]):
    values = read(exposition(tmp_path, loader_1=health))
    assert at(values, "sitegrid_agent_heard_timestamp_seconds", machine="loader-1") == 1e9 + 0.25
    assert not [key for key in values if key[0].startswith("sitegrid_agent_spool")]


def test_the_operators_page_names_every_metric_with_its_labels(tmp_path: Path):
    text = exposition(tmp_path, loader_1=HEALTH)
    exposed = {(name, frozenset(label for label, _ in labels)) for name, labels in read(text)}
    page = (ROOT / "docs" / "operation.md").read_text().split("## Metrics")[1].split("\nCounters")[0]
    named = re.findall(r"`((?:sitegrid|process)_\w+)(?:\{(.*?)\})?`", page)
    assert {(name, frozenset(filter(None, labels.split(",")))) for name, labels in named} == exposed


@pytest.mark.parametrize("file", ["prometheus/rules.yml", "grafana/site.json"])
def test_alarms_and_dashboard_use_metrics_and_labels_that_exist(tmp_path: Path, file: str):
    exposed: dict[str, set[str]] = {
        name: {label for label, _ in labels} for name, labels in read(exposition(tmp_path, loader_1=HEALTH))
    }
    exposed |= {"sitegrid_web_server_away": {"site"}}
    text = (ROOT / "config" / file).read_text().replace('\\"', '"')
    used = re.findall(r"\b((?:sitegrid|process)_\w+)(?:\{(\w+)=)?", text)
    assert len(used) > 10
    assert not [name for name, label in used if name not in exposed or label not in {"", *exposed[name]}]


def test_every_alarm_has_its_row_in_the_operators_page():
    rules = YAML(typ="safe").load(ROOT / "config/prometheus/rules.yml")
    page = (ROOT / "docs/operation.md").read_text().split("## When an alarm goes off")[1]
    named = {rule["annotations"]["runbook"] for group in rules["groups"] for rule in group["rules"]}
    assert not {name for name in named if f"| `{name}` |" not in page}


class One(Collector):
    def __init__(self, *, fails: bool = False) -> None:
        self.fails = fails

    def describe(self) -> Iterable[Metric]:
        return []

    def collect(self) -> Iterable[Metric]:
        assert not self.fails
        metric = Metric("one", "One.", "gauge")
        metric.add_sample("one", {}, 1)
        return [metric]


@pytest.fixture
def exporter() -> Iterator[Exporter]:
    with closing(Exporter(("127.0.0.1", 0), One())) as opened:
        yield opened


def fetch(url: str) -> tuple[str, Values]:
    with urllib.request.urlopen(url, timeout=10) as answer:
        return answer.headers["Content-Type"], read(answer.read().decode())


def status(url: str) -> int:
    with pytest.raises(urllib.error.HTTPError) as error:
        fetch(url)
    error.value.close()
    return error.value.code


def test_metrics_are_served_with_those_of_the_process_and_nothing_else(exporter: Exporter):
    assert exporter.url.startswith("http://127.0.0.1:")
    for url in (exporter.url, f"{exporter.url}?name=x"):
        kind, values = fetch(url)
        assert kind == "text/plain; version=0.0.4; charset=utf-8"
        assert at(values, "one") == 1
        assert at(values, "process_resident_memory_bytes") > 0
    assert status(exporter.url.replace("/metrics", "/")) == 404


def test_a_failure_is_logged_and_answered(caplog: pytest.LogCaptureFixture):
    with closing(Exporter(("127.0.0.1", 0), One(fails=True))) as opened:
        assert status(opened.url) == 503
    assert "metrics failed" in caplog.text


def test_a_visitor_that_says_nothing_keeps_nobody_waiting_nor_the_end():
    opened = Exporter(("127.0.0.1", 0), One())
    port = int(opened.url.rsplit(":", 1)[1].split("/")[0])
    with socket.create_connection(("127.0.0.1", port)):
        assert at(fetch(opened.url)[1], "one") == 1
        opened.close()
    with pytest.raises(urllib.error.URLError):
        fetch(opened.url)


def test_an_address_in_use_is_named():
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        host, port = other.getsockname()
        with pytest.raises(LinkError, match=rf"127.0.0.1:{port}: cannot listen .* choose another address"):
            Exporter((host, port), One())


@contextmanager
def listening() -> Iterator[tuple[Any, HealthListener]]:
    with routed() as (router, client), closing(HealthListener(router, "pit", lambda: 7.0)) as listener:
        yield client, listener


def test_health_is_received_from_every_agent_under_its_own_name():
    with listening() as (client, listener):
        wrong = encode_health(Health("loader-9", NOW_NS, {}))
        for name, payload in (("loader-2", wrong), ("loader-3", b"x"), ("loader-4", b"x" * (MAX_SMALL_BYTES + 1))):
            client.put(keys.health("pit", name), payload)

        def comes_in() -> bool:
            client.put(keys.health("pit", "loader-1"), encode_health(Health("loader-1", NOW_NS, HEALTH)))
            return "loader-1" in listener.received()

        until(comes_in, "a router's knowledge of listeners spreads by itself")
        received = listener.received()
    assert list(received) == ["loader-1"], "without what cannot be read, or comes under another's key"
    assert received["loader-1"] == ReceivedHealth(HEALTH, 7.0)


def test_made_up_names_do_not_fill_the_memory():
    class Sample:
        def __init__(self, name: str) -> None:
            self.key_expr = keys.health("pit", name)
            self.payload = self
            self.data = encode_health(Health(name, NOW_NS, {"n": 1}))

        def to_bytes(self) -> bytes:
            return self.data

    with listening() as (_, listener):
        for i in range(MOST_NAMES + 10):
            listener._on_health(Sample(f"m{i}"))  # type: ignore[arg-type]
        assert len(listener.received()) == MOST_NAMES
        listener._on_health(Sample("m1"))  # type: ignore[arg-type]
        assert "m1" in listener.received()
