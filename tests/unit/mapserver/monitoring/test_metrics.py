"""Metrics: what the server tells, in a text that a strict reader of the format takes."""

from __future__ import annotations

import re
import socket
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import pytest

from mapserver.monitoring.exporter import MOST_AGENTS, Exporter, HealthEar, look, text_of
from mapserver.monitoring.metrics import Heard, Host, Metric, metrics_of, render
from mapserver.server import Server
from protocol.errors import LinkError
from protocol.wire import keys
from protocol.wire.codec import MAX_SMALL_BYTES, encode_batch, encode_health
from protocol.wire.messages import Health, SampleBatch
from tests.unit.mapserver.data import CONFIG, NOW_NS, SITE, now_ns, routed, samples  # beside this file

Read = dict[tuple[str, frozenset[tuple[str, str]]], float]
HOST = Host(2**20, 1.5, 1e9, 4096, 10**10, 0.002)
INFO = {
    "site": {"name": "pit"},
    "journalled": 12,
    "merged": 11,
    "snapshot": 5,
    "samples_merged": 300,
    "samples_too_unsure": 4,
    "cells": 250,
    "stamp_ns": NOW_NS,
    "machines": {
        "loader-1": {"spools": 1, "samples": 200, "lost": 3, "newest_ns": NOW_NS},
        "loader-2": {"spools": 2, "samples": 104, "lost": 0, "newest_ns": NOW_NS - 10**9},
    },
    "distrusted": ["loader-2"],
    "counters": {"batches": 12, "samples_trimmed": 7, "refused_gap": 2, "refused_query_unknown_layer": 1},
}
HEALTH = {
    "spool": {"depth": 40, "unsaved": 1, "recorded": 90, "dropped": 2, "put_aside": 1},
    "uplink": {"problem": "no answer"},
    "spool_problem": "",
}
_LABEL = re.compile(r'([a-zA-Z_][a-zA-Z0-9_]*)="((?:[^"\\\n]|\\["\\n])*)"')
_LINE = re.compile(r"([a-zA-Z_:][a-zA-Z0-9_:]*)(?:\{(.*)\})? (NaN|[+-]Inf|[+-]?[0-9.]+(?:e[+-]?[0-9]+)?)")


def read(text: str) -> Read:
    """Read an exposition by the rules of the format, strictly; an independent reader, to check the writer."""
    assert text.endswith("\n")
    found: Read = {}
    closed: set[str] = set()
    name = kind = ""
    for line in text[:-1].split("\n"):
        if line.startswith("# HELP "):
            closed.add(name)
            name = line.split(" ", 3)[2]
            assert name not in closed, f"{name} comes in two parts"
            assert line.split(" ", 3)[3]
            kind = ""
        elif line.startswith("# TYPE "):
            assert (line.split(" ")[2], kind) == (name, ""), "TYPE follows its own HELP, once"
            kind = line.split(" ")[3]
            assert kind in ("counter", "gauge")
            assert (kind == "counter") == name.endswith("_total")
        else:
            match = _LINE.fullmatch(line)
            assert match, line
            assert kind, "rows stand below a TYPE"
            assert match[1] == name, "rows stand below their own HELP"
            labels = _LABEL.findall(match[2] or "")
            assert ",".join(f'{key}="{text}"' for key, text in labels) == (match[2] or ""), line
            assert len(dict(labels)) == len(labels), "a label comes once"
            key = (name, frozenset((label, _plain(text)) for label, text in labels))
            assert key not in found, f"{line} is told twice"
            found[key] = float(match[3])
    return found


def _plain(text: str) -> str:
    return re.sub(r"\\(.)", lambda match: {"n": "\n"}.get(match[1], match[1]), text)


def at(found: Read, name: str, **labels: str) -> float:
    return found[name, frozenset(labels.items())]


def test_everything_that_the_server_knows_is_told():
    found = read(render(metrics_of(INFO, {"loader-1": Heard(HEALTH, 1e9)}, HOST, "1.2")))
    assert at(found, "sitegrid_info", site="pit", version="1.2") == 1
    assert at(found, "sitegrid_batches_total") == 12
    assert at(found, "sitegrid_batches_refused_total", reason="gap") == 2
    assert at(found, "sitegrid_queries_refused_total", reason="unknown_layer") == 1
    assert not [key for key in found if ("reason", "query_unknown_layer") in key[1]]
    assert at(found, "sitegrid_samples_trimmed_total") == 7
    rows = [at(found, f"sitegrid_{name}_rows") for name in ("journal", "merged", "snapshot")]
    assert rows == [12, 11, 5]
    assert at(found, "sitegrid_map_samples") == 300
    assert at(found, "sitegrid_map_samples_too_unsure") == 4
    assert at(found, "sitegrid_map_cells") == 250
    assert at(found, "sitegrid_map_newest_timestamp_seconds") == NOW_NS / 1e9
    assert at(found, "sitegrid_machine_samples_total", machine="loader-2") == 104
    assert at(found, "sitegrid_machine_samples_lost_total", machine="loader-1") == 3
    newest = at(found, "sitegrid_machine_newest_timestamp_seconds", machine="loader-2")
    assert newest == pytest.approx(NOW_NS / 1e9 - 1)
    assert [at(found, "sitegrid_machine_trusted", machine=f"loader-{i}") for i in (1, 2)] == [1, 0]
    assert at(found, "sitegrid_turn_seconds") == 0.002
    assert at(found, "sitegrid_store_bytes") == 4096
    assert at(found, "sitegrid_store_free_bytes") == 10**10
    assert at(found, "process_resident_memory_bytes") == 2**20
    assert at(found, "process_cpu_seconds_total") == 1.5
    assert at(found, "process_start_time_seconds") == 1e9


def test_agents_are_told_of_as_they_were_heard():
    found = read(render(metrics_of(INFO, {"loader-1": Heard(HEALTH, 1e9 + 0.25)}, HOST, "1")))
    assert at(found, "sitegrid_agent_heard_timestamp_seconds", machine="loader-1") == 1e9 + 0.25
    for name, value in (("spool_samples", 40), ("unsaved_samples", 1), ("samples_recorded_total", 90)):
        assert at(found, f"sitegrid_agent_{name}", machine="loader-1") == value
    assert at(found, "sitegrid_agent_samples_dropped_total", machine="loader-1") == 2
    assert at(found, "sitegrid_agent_samples_aside_total", machine="loader-1") == 1
    assert at(found, "sitegrid_agent_problem", machine="loader-1", part="uplink") == 1
    assert at(found, "sitegrid_agent_problem", machine="loader-1", part="spool") == 0
    assert not [key for key in found if ("part", "calibration") in key[1]], "it said nothing of it"


@pytest.mark.parametrize("values", [{}, {"spool": 7, "uplink": "x"}, {"spool": {"depth": "many"}, "uplink": []}])
def test_whatever_an_agent_sends_the_rest_is_told(values: dict[str, object]):
    found = read(render(metrics_of(INFO, {"loader-1": Heard(values, 1e9)}, HOST, "1")))
    assert at(found, "sitegrid_agent_heard_timestamp_seconds", machine="loader-1") == 1e9
    assert not [key for key in found if key[0].startswith("sitegrid_agent_spool")]


def test_the_writer_is_told_of_where_it_tells_of_itself():
    writer = {"waiting": 3, "commits": 20, "commit_s": 0.5}
    found = read(render(metrics_of({**INFO, "writer": writer}, {}, HOST, "1")))
    assert at(found, "sitegrid_waiting_batches") == 3
    assert at(found, "sitegrid_commits_total") == 20
    assert at(found, "sitegrid_commit_seconds_total") == 0.5
    assert "commit" not in render(metrics_of(INFO, {}, HOST, "1"))


def test_the_operators_page_names_every_metric_with_its_labels(root: Path):
    writer = {"waiting": 3, "commits": 20, "commit_s": 0.5}
    metrics = metrics_of({**INFO, "writer": writer}, {"loader-1": Heard(HEALTH, 1e9)}, HOST, "1")
    told = {(metric.name, ",".join(metric.rows[0][0])) for metric in metrics}
    page = (root / "docs" / "operation.md").read_text().split("## Metrics")[1].split("\nCounters")[0]
    named = set(re.findall(r"`((?:sitegrid|process)_\w+)(?:\{(.*?)\})?`", page))
    assert named == told


def test_labels_and_helps_of_any_text_are_escaped():
    text = 'a "b"\\n\n\\'
    metric = Metric("one_total", "counter", 'back\\slash\nand "line"', (({"what": text, "more": ""}, 1.0),))
    shown = render([metric])
    assert shown.splitlines()[0] == '# HELP one_total back\\\\slash\\nand "line"'
    assert read(shown) == {("one_total", frozenset({("what", text), ("more", "")})): 1.0}


@pytest.mark.parametrize("value", [0.0, -1.5, 1e-9, 1e300, float(2**53 - 1), 1767225600.25, float("inf")])
def test_numbers_come_back_as_they_were(value: float):
    (found,) = read(render([Metric("one", "gauge", "One.", (({}, value),))])).values()
    assert found == value
    assert "NaN" in render([Metric("one", "gauge", "One.", (({}, float("nan")),))])


@pytest.mark.parametrize(("name", "kind"), [("Bad-name", "gauge"), ("good", "timer")])
def test_names_and_kinds_that_prometheus_does_not_know_are_refused(name: str, kind: str):
    with pytest.raises(ValueError, match=name):
        Metric(name, kind, "One.", ())


# --- the edge --------------------------------------------------------------------------------------------------------


@pytest.fixture
def exporter() -> Iterator[Callable[[Callable[[], str]], str]]:
    opened: list[Exporter] = []

    def start(text: Callable[[], str]) -> str:
        opened.append(Exporter(("127.0.0.1", 0), text))
        return opened[-1].url

    yield start
    for one in opened:
        one.close()


def fetch(url: str) -> tuple[str, str]:
    with urllib.request.urlopen(url, timeout=10) as answer:
        return answer.headers["Content-Type"], answer.read().decode()


def status(url: str) -> int:
    with pytest.raises(urllib.error.HTTPError) as error:
        fetch(url)
    error.value.close()
    return error.value.code


def test_metrics_are_served_and_nothing_else(exporter: Callable[[Callable[[], str]], str]):
    url = exporter(lambda: "one 1\n")
    assert fetch(url) == ("text/plain; version=0.0.4; charset=utf-8", "one 1\n")
    assert fetch(f"{url}?name=x")[1] == "one 1\n"
    assert status(url.replace("/metrics", "/")) == 404


def test_a_failure_is_logged_and_answered(exporter: Callable[[Callable[[], str]], str], caplog):
    assert status(exporter(lambda: str(1 / 0))) == 503
    assert "metrics failed" in caplog.text


def test_a_visitor_that_says_nothing_keeps_nobody_waiting(exporter: Callable[[Callable[[], str]], str]):
    url = exporter(lambda: "one 1\n")
    port = int(url.rsplit(":", 1)[1].split("/")[0])
    with socket.create_connection(("127.0.0.1", port)):
        assert fetch(url)[1] == "one 1\n"


def test_an_address_in_use_is_named():
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        host, port = other.getsockname()
        with pytest.raises(LinkError, match=rf"127.0.0.1:{port}: cannot listen .* choose another address"):
            Exporter((host, port), str)


def test_this_process_is_looked_at(tmp_path: Path):
    (tmp_path / "archive").mkdir()
    (tmp_path / "archive" / "one").write_bytes(b"x" * 1000)
    (tmp_path / "two").write_bytes(b"x" * 24)
    host = look(tmp_path, 0.5)
    assert 10 * 2**20 < host.resident_bytes < 2**34
    assert host.cpu_s > 0
    assert 0 < time.time() - host.started_s < 3600
    assert (host.store_bytes, host.turn_s) == (1024, 0.5)
    assert host.free_bytes > 0


def heard_soon(ear: HealthEar, name: str, put: Callable[[], object]) -> Heard:
    """Put until it is heard: a router's knowledge of listeners spreads by itself."""
    end_s = time.monotonic() + 10
    while name not in (found := ear.heard()):
        assert time.monotonic() < end_s
        put()
        threading.Event().wait(0.02)
    return found[name]


def test_health_is_heard_from_every_agent_under_its_own_name():
    with routed() as (router, client), closing(HealthEar(router, "pit", lambda: 7.0)) as ear:
        wrong = encode_health(Health("loader-9", NOW_NS, {}))
        for name, payload in (("loader-2", wrong), ("loader-3", b"x"), ("loader-4", b"x" * (MAX_SMALL_BYTES + 1))):
            client.put(keys.health("pit", name), payload)
        newest = encode_health(Health("loader-1", NOW_NS, HEALTH))
        found = heard_soon(ear, "loader-1", lambda: client.put(keys.health("pit", "loader-1"), newest))
        assert (found.values, found.heard_s) == (HEALTH, 7.0)
        assert list(ear.heard()) == ["loader-1"], "what cannot be read, or comes under another's key, is left out"


def test_made_up_names_do_not_fill_the_memory():
    with routed() as (router, _), closing(HealthEar(router, "pit")) as ear:

        class Sample:
            def __init__(self, name: str) -> None:
                self.key_expr = keys.health("pit", name)
                self.payload = self
                self.data = encode_health(Health(name, NOW_NS, {"n": 1}))

            def to_bytes(self) -> bytes:
                return self.data

        for i in range(MOST_AGENTS + 10):
            ear._on_health(Sample(f"m{i}"))  # type: ignore[arg-type]
        assert len(ear.heard()) == MOST_AGENTS
        ear._on_health(Sample("m1"))  # type: ignore[arg-type]
        assert "m1" in ear.heard()


def test_a_server_tells_its_metrics(tmp_path: Path):
    with routed() as (router, client), closing(Server(router, tmp_path, SITE, CONFIG, now_ns)) as server:
        batch = encode_batch(SampleBatch("loader-1", 5, 3, samples(4), SITE.frame, lost_before=2))
        for payload in (batch, batch, b"nonsense"):
            list(client.get(keys.ingest("pit", "loader-1"), payload=payload, timeout=10.0))
        found = read(text_of(server.answers.info, dict, tmp_path, "1"))
    assert at(found, "sitegrid_batches_total") == 1
    assert at(found, "sitegrid_batches_refused_total", reason="not_msgpack") == 1
    assert at(found, "sitegrid_samples_trimmed_total") == 4
    assert at(found, "sitegrid_machine_samples_total", machine="loader-1") == 4
    assert at(found, "sitegrid_machine_samples_lost_total", machine="loader-1") == 2
    assert at(found, "sitegrid_store_bytes") > 1000
