"""The main job, through real processes: machines drive, one site grid grows."""

from __future__ import annotations

import os

import numpy as np
import pytest

from protocol.errors import LinkError, QueryError
from protocol.wire.session import free_endpoint
from sim.config import SimConfig
from sitegrid.client import connect
from sitegrid.process.children import Children
from tests.integration.site_run import SiteRun, kill  # beside this file
from tests.patience import PATIENCE_S, until

pytestmark = pytest.mark.processes


def test_several_machines_merge_into_one_grid(site_run: SiteRun):
    router, server, sim = site_run.start()
    pids = [child.pid for child in (router, server, sim, *site_run.agents.values())]
    assert len({*pids, os.getpid()}) == 7
    with site_run.connect() as client:
        site_run.wait_merged(client, 50)
        during = client.info()
        assert sim.code is None, "the query is answered while machines drive"
        assert client.point(0.0, 0.0, after=during.journalled).merged >= during.journalled
        reports = site_run.delivered()
        info = client.info()
        region = client.region((0, 0, 200, 150), ["resistance", "visits"])
    assert set(info.machines) == set(site_run.agents)
    assert info.samples_merged + info.samples_too_unsure == sum(r["samples"] for r in reports.values())
    known = np.isfinite(region["resistance"])
    assert known.sum() > 500
    assert np.nanmax(region["visits"]) >= 1
    assert np.isnan(region["visits"][~known]).any()
    server.stop()
    result = site_run.audit_without_loss()
    assert result.recorded == result.merged > 300


def test_a_server_killed_in_mid_run_loses_nothing(site_run: SiteRun):
    _, server, sim = site_run.start()
    with site_run.connect() as client:
        site_run.wait_merged(client, 60)
        kill(server)
        assert sim.code is None
        again = site_run.start_server()
        assert again.pid != server.pid
        reports = site_run.delivered()
        site_run.wait_merged(client, 1)
    assert again.stop() == 0
    result = site_run.audit_without_loss()
    assert result.recorded == sum(report["samples"] for report in reports.values())


def test_an_agent_killed_in_mid_run_loses_nothing_that_it_recorded(site_run: SiteRun):
    _, server, sim = site_run.start()
    config = site_run.configs[0]
    with site_run.connect() as client:
        site_run.wait_merged(client, 60)
        kill(site_run.agents[config.stem])
        assert sim.code is None
        site_run.start_agent(config)
        site_run.delivered()
    server.stop()
    site_run.audit_without_loss()


def test_a_router_killed_in_mid_run_loses_nothing(site_run: SiteRun):
    router, server, _ = site_run.start()
    with site_run.connect() as client:
        site_run.wait_merged(client, 60)
    kill(router)
    site_run.start_router()
    site_run.delivered()
    server.stop()
    site_run.audit_without_loss()


def test_two_sites_do_not_mix(tmp_path, children: Children):
    endpoint = free_endpoint()
    runs = []
    for name, seed in (("north", 4), ("south", 5)):
        folder = tmp_path / name
        folder.mkdir()
        sim = SimConfig(site=name, machines=1, names=(f"{name}-loader",), seconds=20, speed=8, seed=seed)
        runs.append(SiteRun(folder, children, endpoint, sim))
    runs[0].start_router()
    servers = [run.start_server() for run in runs]
    for run in runs:
        run.start_agents()
        config = tmp_path / f"{run.site}-sim.toml"
        config.write_text(f'site = "{run.site}"\nmachines = 1\nnames = ["{run.sim.names[0]}"]\n')
        words = ("--seconds", run.sim.seconds, "--speed", run.sim.speed, "--seed", run.sim.seed)
        children.start("sim", "sim", "--endpoint", endpoint, "--config", config, *words, "--json")
    reports = [run.end_of_agents() for run in runs]
    for run, report in zip(runs, reports, strict=True):
        with run.connect() as client:
            info = client.info()
        assert list(info.machines) == [run.sim.names[0]]
        assert info.machines[run.sim.names[0]].samples == report[run.sim.names[0]]["samples"] > 50
    for server, run in zip(servers, runs, strict=True):
        server.stop()
        assert (run.audit().lost, run.audit().unrecorded) == (0, 0)


def test_an_agent_runs_on_without_a_router_and_catches_up(site_run: SiteRun, children: Children, tmp_path):
    site_run.children.start("record", "sim", "--record", tmp_path / "logs", "--seconds", 30, "--machines", 1).wait(
        PATIENCE_S
    )
    log, spool = tmp_path / "logs" / "loader-1", tmp_path / "loader-1.db"
    files = ("--spool", spool, "--audit", tmp_path / "loader-1.audit")
    words = ("--endpoint", site_run.endpoint, "--driver", "replay", "--log", log, "--speed", "0")
    agent = children.start("loader-1", "agent", *words, "--site-file", site_run.site_file, *files, "--json")
    agent.expect("ready", PATIENCE_S)
    audit = tmp_path / "loader-1.audit"
    until(lambda: audit.exists() and audit.read_text().count("\n") > 100, "samples recorded offline")
    assert agent.code is None
    site_run.start_router()
    server = site_run.start_server()
    report = agent.expect("ended", PATIENCE_S)["ended"]
    assert report["delivered"]
    assert report["uplink"]["counters"].get("unanswered", 0) > 0, "it noticed that nobody answered"
    server.stop()
    site_run.configs = [tmp_path / "loader-1.toml"]
    result = site_run.audit()
    assert (result.lost, result.double) == (0, 0)
    assert result.recorded > 100


def test_queries_that_are_refused_are_counted_and_say_why(site_run: SiteRun):
    site_run.start_router()
    site_run.start_server()
    with site_run.connect() as client:
        with pytest.raises(QueryError, match="layer `gold` is not known; known: resistance"):
            client.point(1, 2, ["gold"])
        with pytest.raises(QueryError, match="is not merged after 0 s") as late:
            client.info(after=99, wait_s=0)
        assert late.value.reason == "after_timeout"
        with pytest.raises(QueryError, match="at most 16000000 are answered"):
            client.region((0, 0, 1e5, 1e5))
        counters = client.info().counters
    assert counters["refused_query_unknown_layer"] == 1
    assert counters["refused_query_after_timeout"] == 1
    assert counters["refused_query_too_large"] == 1


def test_a_site_without_a_server_says_what_to_do(site_run: SiteRun):
    site_run.start_router()
    with (
        connect(site_run.endpoint, site_run.site, timeout_s=1.0) as client,
        pytest.raises(LinkError, match="start one with `sitegrid server`"),
    ):
        client.info()
