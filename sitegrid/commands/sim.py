"""`sitegrid sim`: simulated machines publish what their sensors say."""

from __future__ import annotations

import dataclasses
from argparse import Namespace
from pathlib import Path

from protocol.errors import ConfigError
from protocol.machine import machine_toml, plain_lines
from protocol.session import SessionConfig
from sim.config import SimConfig, load_sim
from sim.publisher import record
from sim.publisher import run as publish
from sim.simulator import Simulator
from sitegrid.process import note, say, stop_flag

OVER = ("seconds", "speed", "machines", "seed", "site")


def run(arguments: Namespace) -> int:
    """Publish, record, or write the configurations that go with the simulation."""
    stop = stop_flag()
    config = _config(arguments)
    if arguments.write_configs:
        write_configs(config, arguments.write_configs)
        return 0
    if arguments.record:
        record(config, arguments.record, arguments.truth)
        say({"recorded": str(arguments.record), "machines": config.machines, "seconds": config.seconds})
        return 0
    report = publish(
        config,
        SessionConfig(arguments.endpoint),
        stop,
        on_progress=(lambda s: say({"simulated_s": round(s, 1)})) if arguments.json else None,
        truth_dir=arguments.truth,
    )
    if arguments.json:
        say({"ended": dataclasses.asdict(report)})
    else:
        note(f"simulated {report.simulated_s:g} s of {report.machines} machines: {report.readings} readings")
    return 0


def write_configs(config: SimConfig, folder: Path) -> list[Path]:
    """Write `site.toml` and `<machine>.toml` for the agents: nominal values, nothing of the truth."""
    simulator = Simulator(config)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "site.toml").write_text("\n".join(plain_lines(simulator.site)) + "\n", encoding="utf-8")
    paths = [folder / f"{machine.name}.toml" for machine in simulator.machines]
    for path, machine in zip(paths, simulator.machines, strict=True):
        path.write_text(machine_toml(machine), encoding="utf-8")
    return paths


def _config(arguments: Namespace) -> SimConfig:
    config = load_sim(arguments.config) if arguments.config else SimConfig()
    over = {name: getattr(arguments, name) for name in OVER if getattr(arguments, name) is not None}
    if "machines" in over and over["machines"] != config.machines:
        over["names"] = ()
    try:
        return dataclasses.replace(config, **over)
    except ValueError as error:
        raise ConfigError("sitegrid sim", str(error)) from None
