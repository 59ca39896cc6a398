"""`sitegrid agent`: the localisation agent of one machine."""

from __future__ import annotations

import dataclasses
import logging
import sys
import time
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import zenoh

from protocol.errors import ConfigError, LinkError
from protocol.machine.log_folder import LogFolder, open_log
from protocol.machine.machine_config import MachineConfig
from protocol.site.site_config import SiteConfig
from protocol.site.site_file import load_site
from protocol.wire.session import SessionConfig, open_session
from sitegrid.health import line_of, summary_of
from sitegrid.options.groups import add_network
from sitegrid.options.values import OutputFile, not_negative
from sitegrid.process.lifetime import note, plain, say, stop_flag
from sitegrid.process.status_line import Due, status_line
from sitegrid.process.supervisor import say_ready, until
from sitegrid.security.join import join, reply_check, signer

if TYPE_CHECKING:
    from agents.agent import Agent
    from agents.config import AgentConfig
    from agents.corrections.delivery import CorrectionsDelivery
    from agents.drivers import Driver
    from protocol.wire.owners import Owner

log = logging.getLogger("sitegrid.status")
HELP = "run the localisation agent of one machine"
EXTRA = "agent"
KEPT = OutputFile(makes_folder=True)
Show = Callable[[dict[str, Any]], None]
LINK_S = 1.0  # timeout for the router before starting without it


def add_options(parser: ArgumentParser) -> None:
    """Options of the command."""
    add = parser.add_argument
    add_network(parser)
    add("--config", type=Path, help="file with machine, sensors and options (config/agent.toml)")
    add("--site-file", type=Path, help="site file (config/site.toml); not needed with --log")
    add("--name", help="name of the machine (overrides the config file)")
    add("--spool", type=KEPT, help="file of the spool")
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
    """A machine in the network under its name."""

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
    session = _open(join(arguments.endpoint, arguments.keys, role="machine", name=machine.name, site=site.name))
    with ExitStack() as opened:
        opened.callback(session.close)
        owner = _claim_name(session, arguments.endpoint, site.name, machine.name)
        joined = _Joined(session, site, machine, config, owner)
        driver = _driver(arguments, log, joined)
        corrections = None if log else _corrections(joined, driver)
        agent = _agent(arguments, joined, corrections)
        opened.callback(agent.close)
        show = opened.enter_context(_shown(machine.name, site.name, stop.is_set, is_json=arguments.json))
        report = agent.run(driver, until(stop), wait=stop.wait, show=show)
    say({"ended": plain(report)}) if arguments.json else note(summary_of(machine.name, report))
    return 0 if report.get("delivered", True) or stop.is_set() else 1


def _agent(arguments: Namespace, joined: _Joined, corrections: CorrectionsDelivery | None) -> Agent:
    from agents.agent import Agent, Places
    from agents.config import require_place

    require_place(joined.machine, joined.config.pipeline.localisation)
    places = Places(arguments.spool, arguments.audit, _calibration(arguments))
    key, check, withhold = signer(arguments.keys), reply_check(arguments.keys), arguments.withhold
    sign = key.sign if key else None
    given = vars(joined) | {"corrections": corrections}
    return Agent(**given, places=places, withhold=withhold, sign=sign, check=check)


def _corrections(joined: _Joined, driver: Driver) -> CorrectionsDelivery | None:
    from agents.corrections.delivery import open_delivery
    from agents.drivers.sources import Sources

    receivers = driver.receivers() if isinstance(driver, Sources) else {}
    return open_delivery(joined.session, joined.site.name, joined.config.corrections, receivers)


def _open(settings: SessionConfig) -> zenoh.Session:
    """Open a session; without a router it keeps trying while the machine records."""
    try:
        return open_session(dataclasses.replace(settings, wait_s=LINK_S))
    except LinkError:
        return open_session(dataclasses.replace(settings, wait_s=-1))


def _claim_name(session: zenoh.Session, endpoint: str, site: str, machine: str) -> Owner:
    """Refuse to start beside an agent of the same name."""
    from agents.presence import find_namesake
    from protocol.wire.owners import this_process

    if other := find_namesake(session, site, machine):
        problem = f"an agent of {machine} runs already, {other}; stop it, or start this one with another --name"
        raise LinkError(endpoint, problem)
    return this_process()


def _calibration(arguments: Namespace) -> Path:
    """By default beside the spool."""
    return Path(arguments.calibration or arguments.spool.with_suffix(".calibration.json"))


def _configure(arguments: Namespace, log: LogFolder | None) -> tuple[SiteConfig, MachineConfig, AgentConfig]:
    from agents.config import AgentConfig, load_agent

    machine, config = load_agent(arguments.config) if arguments.config else (None, AgentConfig())
    if arguments.driver == "replay" and log is None:
        raise ConfigError("sitegrid agent", "--driver replay needs --log MANIFEST")
    machine = machine or (log.machine if log else None)
    if machine is None:
        raise ConfigError(arguments.config or "sitegrid agent", "no [machine] is described; see config/agent.toml")
    if not arguments.spool:
        raise ConfigError("sitegrid agent", "--spool FILE is missing: samples wait there until they are acknowledged")
    if arguments.name:
        machine = dataclasses.replace(machine, name=arguments.name)
    if arguments.site_file:
        return load_site(arguments.site_file), machine, config
    if log is None:
        raise ConfigError("sitegrid agent", "--site-file is missing; see config/site.toml")
    return log.site, machine, config


def _driver(arguments: Namespace, log: LogFolder | None, joined: _Joined) -> Driver:
    from agents.drivers.replay import Replay
    from agents.drivers.tables import open_sources
    from agents.drivers.zenoh import ZenohDriver

    if log:
        return Replay(log, arguments.speed, time.monotonic, time.sleep)

    def bundles() -> ZenohDriver:
        return ZenohDriver(joined.session, joined.site.name, joined.machine.name)

    if not joined.config.driver:
        return bundles()
    return open_sources(joined.config.driver, joined.machine, lambda: (time.time_ns(), time.monotonic_ns()), bundles)


@contextmanager
def _shown(machine: str, site: str, is_stopped: Callable[[], bool], *, is_json: bool) -> Iterator[Show]:
    """Report readiness and status: for people on a terminal, else for programs."""
    if is_json or not sys.stderr.isatty():
        say_ready({"ready": "agent", "machine": machine, "site": site})
        due = Due()
        yield lambda report: _log(machine, report) if due.is_due(report["status"]) else None
        return
    if sys.stdout.isatty():
        note(f"{machine} draws the map of {site}; Ctrl-C ends it")
    else:
        say_ready({"ready": "agent", "machine": machine, "site": site})
    with status_line() as line:
        yield lambda report: line.show("" if is_stopped() else line_of(machine, report))


def _log(machine: str, report: dict[str, Any]) -> None:
    place, counts = report["pipeline"], (report["samples"], report["acknowledged"])
    std_m, speed_mps = (None if v is None else round(v, 2) for v in (place["position_std_m"], place["speed_mps"]))
    template = "status machine=%s status=%r position_std_m=%s speed_mps=%s samples=%d delivered=%d"
    log.info(template, machine, report["status"], std_m, speed_mps, *counts)
