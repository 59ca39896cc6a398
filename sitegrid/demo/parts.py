"""The processes of the demo, each its own `sitegrid` command, and the replay of a real log beside the simulation."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from evaluation.audit import audit_store
from mapserver.config import ServerConfig
from protocol.machine.log_folder import LogFolder
from sitegrid.client import connect
from sitegrid.demo.plan import SIM_OPTIONS, DemoPlan
from sitegrid.pictures.draw import TrackRecorder, draw
from sitegrid.process.children import Child, Children, wait_until

READY_S = 30.0
LOG_SPEED = 20.0  # times real time


def start_server(plan: DemoPlan, children: Children, name: str, site_file: Path) -> Child:
    """A map server, ready."""
    store = plan.work / ("store" if name == "server" else f"store-{name}")
    words = ("server", "--endpoint", plan.endpoint, "--site-file", site_file, "--store", store)
    child = children.start(name, *words)
    child.expect("ready", READY_S)
    return child


def start_agent(plan: DemoPlan, children: Children, config: Path) -> Child:
    """The agent of one machine of the simulation."""
    name = config.stem
    files = ("--spool", plan.work / f"{name}.db", "--audit", plan.work / f"{name}.audit")
    base = ("agent", "--endpoint", plan.endpoint, "--site-file", plan.site_file, "--config", config)
    return children.start(name, *base, *files, "--json")


def start_sim(plan: DemoPlan, children: Children) -> Child:
    """The simulator."""
    options = {name: getattr(plan.config, name) for name in SIM_OPTIONS}
    words = [word for name, value in options.items() if value is not None for word in (f"--{name}", value)]
    return children.start("sim", "sim", "--endpoint", plan.endpoint, *words, "--truth", plan.truth, "--json")


class LogReplay:
    """A real log, replayed by an agent of its own into a site with a map server of its own."""

    def __init__(self, plan: DemoPlan, log: LogFolder, children: Children) -> None:
        assert plan.manifest is not None
        self._site = log.site
        self._machine = log.machine.name
        self._server = start_server(plan, children, "log-server", plan.manifest)
        self._client = connect(plan.endpoint, log.site.name)
        self._tracks = TrackRecorder(self._client.session, log.site.name)
        files = ("--spool", plan.work / "log.db", "--audit", plan.work / "log.audit")
        source = ("--driver", "replay", "--log", plan.manifest, "--data", log.data, "--speed", LOG_SPEED)
        words = ("agent", "--endpoint", plan.endpoint, *source, *files, "--withhold", "--json")
        self._agent = children.start("log-agent", *words)

    def finish(self, plan: DemoPlan) -> dict[str, Any]:
        """Wait for the agent, draw its map, compare with its audit file."""
        report = self._agent.expect("ended", 300.0)["ended"]
        wait_until(lambda: self._client.info().merged == self._client.info().journalled, READY_S, "log-server")
        picture = plan.out / "log-map.png"
        draw(self._client, picture, None, self._tracks.tracks())
        self._tracks.close()
        self._client.close()
        self._server.stop()
        audits = {self._machine: plan.work / "log.audit"}
        audit = audit_store(audits, plan.work / "store-log-server", self._site, ServerConfig())
        withheld = {f"withheld_{key}": value for key, value in report["holdout"].items()}
        return {"name": self._machine, **asdict(audit), **withheld, "picture": str(picture)}
