"""The processes of the demo, each started as its own `sitegrid` command."""

from __future__ import annotations

from pathlib import Path

from sitegrid.demo.plan import DemoPlan
from sitegrid.process.children import Child, Children

READY_S = 30.0


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
    c = plan.config
    options = {name: getattr(c, name) for name in ("scenario", "world", "machines", "seed", "seconds", "speed")}
    words = [word for name, value in options.items() if value is not None for word in (f"--{name}", value)]
    return children.start("sim", "sim", "--endpoint", plan.endpoint, *words, "--truth", plan.truth, "--json")
