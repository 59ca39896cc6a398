"""A site of real processes on free loopback ports, ended with the test."""

from __future__ import annotations

import signal
from collections.abc import Callable
from pathlib import Path

from mapserver.config import ServerConfig
from protocol.site.site_file import load_site
from sim.config import SimConfig, resolve, write_configs
from sitegrid import Client, connect
from sitegrid.process.children import Child, Children
from sitegrid.proof.delivery import AuditResult, audit_store
from tests.patience import PATIENCE_S, until

LAG_S = 4.0  # smoother lag: drives are short, and tests wait for samples
NOBODY_DRIVES = SimConfig(machines=1, seconds=0, speed=4, seed=3, world="fast")


class SiteRun:
    def __init__(self, folder: Path, children: Children, endpoint: str, sim: SimConfig, lag_s: float = LAG_S) -> None:
        self.folder = folder
        self.children = children
        self.endpoint = endpoint
        self.sim = sim
        self.site = resolve(sim).site.name
        self.configs = write_configs(sim, folder)
        for config in self.configs:
            text = config.read_text(encoding="utf-8")
            text = f"linger_s = {PATIENCE_S}\n{text}\n[pipeline.localisation]\nlag_s = {lag_s}\n"
            config.write_text(text, encoding="utf-8")
        self.agents: dict[str, Child] = {}

    @property
    def site_file(self) -> Path:
        return self.folder / "site.toml"

    def start_router(self) -> Child:
        self.router = self.children.start("router", "router", "--listen", self.endpoint)
        self.router.expect("ready", PATIENCE_S)
        return self.router

    def start_server(self, *options: str) -> Child:
        words = ("--endpoint", self.endpoint, "--site-file", self.site_file, "--store", self.folder / "store")
        self.server = self.children.start("server", "server", *words, *options)
        self.server.expect("ready", PATIENCE_S)
        return self.server

    def start_agent(self, config: Path) -> Child:
        name = config.stem
        files = ("--spool", self.folder / f"{name}.db", "--audit", self.folder / f"{name}.audit")
        where = ("--endpoint", self.endpoint, "--site-file", self.site_file, "--config", config)
        self.agents[name] = self.children.start(name, "agent", *where, *files, "--json")
        self.agents[name].expect("ready", PATIENCE_S)
        return self.agents[name]

    def start_agents(self) -> None:
        for config in self.configs:
            self.start_agent(config)

    def start(self) -> tuple[Child, Child, Child]:
        """Start everything; returns router, server, simulator."""
        router, server = self.start_router(), self.start_server()
        self.start_agents()
        return router, server, self.start_sim()

    def start_sim(self, *options: str | Path) -> Child:
        names = ("seconds", "speed", "machines", "seed", "world")
        words = [w for name in names for w in (f"--{name}", getattr(self.sim, name))]
        place = ("--endpoint", self.endpoint, "--site", self.site)
        return self.children.start("sim", "sim", *place, *words, *options, "--json")

    def connect(self) -> Client:
        return connect(self.endpoint, self.site, timeout_s=PATIENCE_S)

    def wait_merged(self, client: Client, samples: int) -> None:
        until(lambda: client.info().samples_merged >= samples, f"{samples} samples merged")

    def end_of_agents(self) -> dict[str, dict]:
        return {name: agent.expect("ended", PATIENCE_S)["ended"] for name, agent in self.agents.items()}

    def delivered(self, progress: Callable[[], object] = lambda: None) -> dict[str, dict]:
        """Final agent reports; everything is delivered. progress: as in `until`, of what agents have still to read."""
        agents = self.agents.values()
        until(lambda: all(agent.code is not None for agent in agents), "end of the agents", progress)
        reports = self.end_of_agents()
        assert all(report["delivered"] for report in reports.values())
        return reports

    def audit(self) -> AuditResult:
        audits = {path.stem: self.folder / f"{path.stem}.audit" for path in self.configs}
        return audit_store(audits, self.folder / "store", load_site(self.site_file), ServerConfig())


def kill(child: Child) -> None:
    child.send(signal.SIGKILL)
    child.wait(PATIENCE_S)
