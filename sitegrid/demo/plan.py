"""The demo's plan: files and processes, a `sitegrid` command each."""

from __future__ import annotations

import shutil
from argparse import Namespace
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from mapserver.config import ServerConfig
from protocol.errors import ConfigError
from protocol.machine.log_folder import LogFolder, open_log
from protocol.wire.session import free_endpoint
from sim.config import SimConfig, resolve, write_configs
from sim.scenario.tables import Scenario
from sitegrid.client import connect
from sitegrid.pictures.draw import TrackRecorder, draw
from sitegrid.process.children import Child, Children, wait_until
from sitegrid.proof.delivery import audit_store

READY_S = 120.0  # silence of a hung process
LOG_SPEED = 20.0  # times real time
SIM_OPTIONS = ("scenario", "world", "machines", "seed", "seconds", "speed")  # passed on by the demo


@dataclass(frozen=True)
class DemoPlan:
    """out, work: folders of pictures, of all else. configs: a file per machine. log: replayed too."""

    out: Path
    work: Path
    endpoint: str
    config: SimConfig
    scenario: Scenario
    configs: list[Path]
    log: LogFolder | None
    manifest: Path | None

    @property
    def site_file(self) -> Path:
        """The simulated site."""
        return self.work / "site.toml"

    @property
    def truth(self) -> Path:
        """Folder of the true map and tracks."""
        return self.work / "truth"

    @property
    def true_map(self) -> Path:
        """The simulation's true map."""
        return self.truth / "truth_map.npz"


def make_plan(arguments: Namespace) -> DemoPlan:
    """Plan from options; empties an earlier run's folder and writes the machines' configurations."""
    try:
        config = SimConfig(**{name: getattr(arguments, name) for name in SIM_OPTIONS})
    except ValueError as error:
        raise ConfigError("sitegrid demo", str(error)) from None
    scenario = resolve(config)
    config = replace(config, world=scenario.world)  # without PyBullet another one than the scenario's; said once
    if arguments.data and not arguments.log:
        raise ConfigError("--data", "is the folder of a log; name the log with --log")
    log = open_log(arguments.log, arguments.data) if arguments.log else None
    work, endpoint = _emptied(arguments.out / "work"), free_endpoint()
    return DemoPlan(arguments.out, work, endpoint, config, scenario, write_configs(config, work), log, arguments.log)


def _emptied(work: Path) -> Path:
    """Empty an earlier run's folder; ConfigError for any other."""
    if work.exists() and any(work.iterdir()) and not (work / "site.toml").exists():
        raise ConfigError(work, "is not of an earlier demo, and would be emptied; choose another --out")
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    return work


def start_server(plan: DemoPlan, children: Children, name: str, site_file: Path) -> Child:
    """Start a map server, ready some seconds later."""
    store = plan.work / ("store" if name == "server" else f"store-{name}")
    words = ("server", "--endpoint", plan.endpoint, "--site-file", site_file, "--store", store)
    return children.start(name, *words)


def start_agent(plan: DemoPlan, children: Children, config: Path) -> Child:
    """Start one simulated machine's agent."""
    name = config.stem
    files = ("--spool", plan.work / f"{name}.db", "--audit", plan.work / f"{name}.audit")
    base = ("agent", "--endpoint", plan.endpoint, "--site-file", plan.site_file, "--config", config)
    return children.start(name, *base, *files, "--json")


def start_web(plan: DemoPlan, children: Children) -> str:
    """Start the live page; returns its address."""
    words = ("web", "--endpoint", plan.endpoint, "--site", plan.scenario.site.name, "--listen", "0")
    return str(children.start("web", *words).expect("ready", READY_S)["url"])


def start_sim(plan: DemoPlan, children: Children) -> Child:
    """Start the simulator."""
    options = {name: getattr(plan.config, name) for name in SIM_OPTIONS}
    words = [word for name, value in options.items() if value is not None for word in (f"--{name}", value)]
    return children.start("sim", "sim", "--endpoint", plan.endpoint, *words, "--truth", plan.truth, "--json")


class LogReplay:
    """A log replayed by its own agent, site and map server."""

    def __init__(self, plan: DemoPlan, log: LogFolder, children: Children) -> None:
        assert plan.manifest is not None
        self._site = log.site
        self._machine = log.machine.name
        self._server = start_server(plan, children, "log-server", plan.manifest)
        self._server.expect("ready", READY_S)
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
