"""compose.yaml's commands as local processes: machines draw a map."""

from __future__ import annotations

import json
import signal
import urllib.request
from pathlib import Path

import pytest

from protocol.errors import SitegridError
from sitegrid import Client, connect
from sitegrid.process.children import Children
from tests.integration import compose_run
from tests.patience import PATIENCE_S, until

pytestmark = [pytest.mark.processes, pytest.mark.nightly]


def known_machines(client: Client) -> set[str]:
    """Machines in the map; empty while a fresh image compiles kernels."""
    try:
        return set(client.info().machines)
    except SitegridError:
        return set()


def test_all_services_of_compose_start_in_order_are_healthy_and_draw_a_map(
    tmp_path: Path, children: Children, root: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(root)
    for name, value in compose_run.image_environment(root / "Dockerfile").items():
        monkeypatch.setenv(name, value.replace("/tmp/", f"{tmp_path}/tmp/"))
    services = compose_run.needed(compose_run.load(root / "compose.yaml"))
    services["sim"]["command"] += ["--speed", "4"]  # samples lag by the smoother's 90 s
    run = compose_run.ComposeRun(services, tmp_path, children)
    run.up()
    order = list(run.started)
    assert order[:2] == ["router", "server"]
    assert order.index("sim") > max(order.index(f"loader-{i}") for i in (1, 2, 3))
    assert sorted(order) == sorted(services)
    with connect(f"tcp/127.0.0.1:{run.ports['7447']}", "paper") as client:
        machines = {"loader-1", "loader-2", "loader-3"}
        until(lambda: known_machines(client) == machines, "samples of every machine merged")
        until(lambda: client.info().cells > 0, "cells known")
    with urllib.request.urlopen(f"http://127.0.0.1:{run.ports['9464']}/metrics", timeout=PATIENCE_S) as answer:
        text = answer.read().decode()
    with urllib.request.urlopen(
        f"http://127.0.0.1:{run.ports['8080']}/api/v1/sites/paper/info", timeout=PATIENCE_S
    ) as answer:
        assert json.load(answer)["cells"] > 0
    assert all(f'sitegrid_machine_samples_total{{machine="{name}"}}' in text for name in machines)
    checked = [name for name, service in services.items() if "healthcheck" in service]
    assert checked == ["router", "server", "web"]
    assert all(run.check(name) for name in checked)
    assert {name: child.code for name, child in run.started.items()} == dict.fromkeys(services), "none has ended"
    # An ended stream's agent is exiting: Python takes a signal in its last moment.
    assert set(run.down().values()) <= {0, -signal.SIGTERM}, "none had to be killed"


def test_a_health_check_fails_without_its_service(
    tmp_path: Path, children: Children, root: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(root)
    run = compose_run.ComposeRun(compose_run.needed(compose_run.load(root / "compose.yaml")), tmp_path, children)
    assert not run.check("router")
    assert not run.check("server")


def test_a_service_that_ends_at_once_is_not_waited_for(
    tmp_path: Path, children: Children, root: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(root)
    services = compose_run.needed(compose_run.load(root / "compose.yaml"))
    services["router"]["command"].remove("--insecure")
    services["router"]["command"][2] = "tcp/256.0.0.1:7447"
    run = compose_run.ComposeRun(services, tmp_path, children)
    with pytest.raises(Exception, match="router: is not healthy"):
        run.up()
    assert list(run.started) == ["router"]
