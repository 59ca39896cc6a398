"""`sitegrid agent`: the localisation agent of one machine, or the agent of a base station."""

from __future__ import annotations

import dataclasses
import threading
import time
from argparse import ArgumentParser, Namespace
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import zenoh

from protocol.errors import ConfigError, LinkError
from protocol.machine.log_folder import LogFolder, open_log
from protocol.machine.machine_config import MachineConfig
from protocol.site.site_config import SiteConfig
from protocol.site.site_file import load_site
from protocol.wire.session import SessionConfig, open_session
from sitegrid.options.groups import add_network
from sitegrid.options.values import OutputFile, not_negative
from sitegrid.process.lifetime import note, plain, say, stop_flag
from sitegrid.security.join import join, reply_check, signer

if TYPE_CHECKING:
    from agents.agent import Agent
    from agents.base_agent import BaseAgent
    from agents.config import AgentConfig
    from agents.drivers import Driver
    from protocol.wire.owners import Owner

    Serve = Callable[[Driver, Callable[[], bool]], dict[str, Any]]

HELP = "run the localisation agent of one machine, or the agent of a base station"
EXTRA = "agent"
KEPT = OutputFile(makes_folder=True)
LINK_S = 1.0  # how long to wait for the router before starting without it


def add_options(parser: ArgumentParser) -> None:
    """Options of the command."""
    add = parser.add_argument
    add_network(parser)
    add("--config", type=Path, help="file with machine, sensors and options (config/agent.toml)")
    add("--site-file", type=Path, help="site file (config/site.toml); not needed with --log")
    add("--name", help="name of the machine (overrides the config file)")
    add("--spool", type=KEPT, help="file of the spool; a base station has none")
    add("--audit", type=KEPT, help="file that lists every recorded sample, to prove that none is lost")
    add("--calibration", type=KEPT, help="calibration file (default: beside the spool)")
    source = "source of the readings: a log, or (default) what [[driver]] says, without one bundles over zenoh"
    add("--driver", choices=("zenoh", "replay"), default="zenoh", help=source)
    add("--log", type=Path, help="replay: manifest of the log")
    add("--data", type=Path, help="replay: folder with the CSV files, if not beside the manifest")
    add("--speed", type=not_negative, default=1.0, help="replay: speed relative to real time; 0 as fast as possible")
    withheld = "withhold part of the GPS fixes ([holdout]) and report the error against them"
    add("--withhold", action="store_true", help=withheld)


@dataclass(frozen=True)
class _Joined:
    """A machine, or a base station, that has joined the network under its name."""

    session: zenoh.Session
    site: SiteConfig
    machine: MachineConfig
    config: AgentConfig
    owner: Owner


def run(arguments: Namespace) -> int:
    """Run until the stream ends or the process is stopped; the router may come and go."""
    stop = stop_flag()
    log = open_log(arguments.log, arguments.data) if arguments.driver == "replay" and arguments.log else None
    site, machine, config = _configure(arguments, log)
    session = _open(join(arguments.endpoint, arguments.keys, role=config.role, name=machine.name, site=site.name))
    with ExitStack() as opened:
        opened.callback(session.close)
        owner = _claim_name(session, arguments.endpoint, site.name, machine.name)
        joined = _Joined(session, site, machine, config, owner)
        agent, serve = (_base if config.role == "base" else _machine)(arguments, joined, stop)
        opened.callback(agent.close)
        driver = _driver(arguments, log, joined)
        say({"ready": "agent", "machine": machine.name, "site": site.name})
        report = serve(driver, stop.is_set)
    say({"ended": plain(report)}) if arguments.json else note(_summary(machine.name, report))
    return 0 if report.get("delivered", True) or stop.is_set() else 1


def _machine(arguments: Namespace, joined: _Joined, stop: threading.Event) -> tuple[Agent | BaseAgent, Serve]:
    from agents.agent import Agent, Places
    from agents.config import require_place

    require_place(joined.machine, joined.config.pipeline.localisation)
    places = Places(arguments.spool, arguments.audit, _calibration(arguments))
    key, check, withhold = signer(arguments.keys), reply_check(arguments.keys), arguments.withhold
    sign = key.sign if key else None
    agent = Agent(**vars(joined), places=places, withhold=withhold, sign=sign, check=check)
    return agent, partial(agent.run, wait=stop.wait)


def _base(_: Namespace, joined: _Joined, __: threading.Event) -> tuple[Agent | BaseAgent, Serve]:
    from agents.base_agent import BaseAgent

    agent = BaseAgent(**vars(joined))
    return agent, agent.run


def _open(settings: SessionConfig) -> zenoh.Session:
    """Open a session; without a router one that goes on looking for it, so that the machine drives and records."""
    try:
        return open_session(dataclasses.replace(settings, wait_s=LINK_S))
    except LinkError:
        return open_session(dataclasses.replace(settings, wait_s=-1))


def _claim_name(session: zenoh.Session, endpoint: str, site: str, machine: str) -> Owner:
    """Refuse to start while another agent of the same name runs."""
    from agents.presence import find_namesake
    from protocol.wire.owners import this_process

    if other := find_namesake(session, site, machine):
        problem = f"an agent of {machine} runs already, {other}; stop it, or start this one with another --name"
        raise LinkError(endpoint, problem)
    return this_process()


def _calibration(arguments: Namespace) -> Path:
    """The calibration lies beside the spool, if nothing else is asked for."""
    return Path(arguments.calibration or arguments.spool.with_suffix(".calibration.json"))


def _configure(arguments: Namespace, log: LogFolder | None) -> tuple[SiteConfig, MachineConfig, AgentConfig]:
    from agents.config import AgentConfig, load_agent

    machine, config = load_agent(arguments.config) if arguments.config else (None, AgentConfig())
    if arguments.driver == "replay" and log is None:
        raise ConfigError("sitegrid agent", "--driver replay needs --log MANIFEST")
    machine = machine or (log.machine if log else None)
    if machine is None:
        raise ConfigError(arguments.config or "sitegrid agent", "no [machine] is described; see config/agent.toml")
    _check_files(arguments, config.role)
    if arguments.name:
        machine = dataclasses.replace(machine, name=arguments.name)
    if arguments.site_file:
        return load_site(arguments.site_file), machine, config
    if log is None:
        raise ConfigError("sitegrid agent", "--site-file is missing; see config/site.toml")
    return log.site, machine, config


def _check_files(arguments: Namespace, role: str) -> None:
    """Refuse a machine without a place for its samples, and a base station with one."""
    if role == "machine" and not arguments.spool:
        raise ConfigError("sitegrid agent", "--spool FILE is missing: samples wait there until they are acknowledged")
    of_samples = [name for name in ("spool", "audit", "calibration", "withhold") if getattr(arguments, name)]
    if role == "base" and of_samples:
        raise ConfigError("sitegrid agent", f"--{of_samples[0]}: a base station makes no samples; leave it out")


def _driver(arguments: Namespace, log: LogFolder | None, joined: _Joined) -> Driver:
    """What readings come from; a log has the corrections that came in when it was recorded."""
    from agents.drivers.replay import Replay
    from agents.drivers.tables import open_sources
    from agents.drivers.zenoh import WithCorrections, ZenohDriver

    if log:
        return Replay(log, arguments.speed, time.monotonic, time.sleep)
    driver: Driver = (
        open_sources(joined.config.driver, joined.machine, lambda: (time.time_ns(), time.monotonic_ns()))
        if joined.config.driver
        else ZenohDriver(joined.session, joined.site.name, joined.machine.name)
    )
    base = joined.machine.base
    return WithCorrections(driver, joined.session, joined.site, base.name) if base else driver


def _summary(machine: str, report: dict[str, Any]) -> str:
    if base := report.get("base"):
        made = base["counters"].get("corrections", 0)
        return f"{machine}: {report['readings']} readings, {made} corrections"
    line = f"{machine}: {report['readings']} readings, {report['samples']} samples"
    withheld = f", withheld fixes {report['holdout']}" if report["holdout"] else ""
    return f"{line}, delivered {report['delivered']}{withheld}"
