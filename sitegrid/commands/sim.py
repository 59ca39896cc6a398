"""`sitegrid sim`: publish simulated machines' sensor readings."""

from __future__ import annotations

import dataclasses
import threading
from argparse import ArgumentParser, Namespace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from protocol.errors import ConfigError
from sitegrid.options.groups import add_network
from sitegrid.options.values import FOLDER, PICTURE
from sitegrid.process.lifetime import END_S, note, say, stop_flag, tell
from sitegrid.process.progress import Display
from sitegrid.security.join import join

if TYPE_CHECKING:
    from sim.config import SimConfig

HELP = "run the simulator: machines drive and publish sensor readings"
EXTRA = "sim"
OVER = ("scenario", "world", "preset", "seconds", "speed", "machines", "seed", "site", "receivers", "can")
ALL_SENSORS = {"gps": (1, 2, 3), "imu": (1, 2, 3, 4), "attitude": (1, 2, 3, 4)}


def add_options(parser: ArgumentParser) -> None:
    """Options of the command."""
    add = parser.add_argument
    add_network(parser)
    add("--config", type=Path, help="file with options (config/sim.toml)")
    add("--scenario", help="name of a scenario, or the path of its .toml file (overrides the config file)")
    add("--world", choices=("pybullet", "fast"), help="physics of the machines (overrides the scenario)")
    add("--preset", help="sensor error preset: paper, dgps, standalone, rtk or harsh (overrides the scenario)")
    for name, kind, what in (
        ("seconds", float, "simulated time in seconds; 0 runs until stopped"),
        ("speed", float, "speed relative to real time; 0 as fast as possible"),
        ("machines", int, "number of machines in the scenario's first fleet"),
        ("seed", int, "random seed"),
    ):
        add(f"--{name}", type=kind, help=f"{what} (overrides the config file)")
    add("--site", help="name of the site in keys (overrides the config file)")
    ports = "folder for the ports on which the machines' receivers speak; what they do not carry is published"
    add("--ports", type=FOLDER, help=ports)
    add("--receivers", choices=("ubx", "nmea"), help="what they speak there (default ubx)")
    add("--can", metavar="BUS", help="bus of the first machine, the others count on (can0): drive trains speak J1939")
    add("--truth", type=FOLDER, help="folder for the true map and the true tracks")
    add("--record", type=FOLDER, help="folder for log folders, one per machine; nothing is published then")
    add("--all-sensors", action="store_true", help="use every GPS receiver and IMU of the machines")
    add("--picture", type=PICTURE, help="draw the site into this file (plan and perspective), then exit")
    configs = "write site.toml and one agent file per machine into this folder, then exit"
    add("--write-configs", type=FOLDER, help=configs)


def run(arguments: Namespace) -> int:
    """Publish, record, draw, or write the agents' configurations."""
    from sim.config import resolve
    from sim.publisher import run as publish

    stop = stop_flag(None if arguments.record else END_S)  # a recording is written at the end
    config = _config(arguments)
    if arguments.write_configs:
        from sim.config import write_configs

        agents = write_configs(config, arguments.write_configs, arguments.ports)
        written = [str(arguments.write_configs / "site.toml"), *map(str, agents)]
        say({"configs": written}) if arguments.json else note("\n".join(written))
    if arguments.picture:
        _draw(config, arguments)
    if arguments.record:
        return _record(config, arguments, stop)
    if arguments.write_configs or arguments.picture:
        return 0
    settings = join(arguments.endpoint, arguments.keys, role="sim", site=resolve(config).site.name)
    if arguments.ports:
        settings = dataclasses.replace(settings, wait_s=-1)  # receivers speak before anybody connects to a router
    where = f"; receivers speak on {arguments.ports}/*" if arguments.ports else ""
    beginning = iter([f"machines drive{where}"])

    def progress(simulated_s: float) -> None:
        if arguments.json:
            say({"simulated_s": round(simulated_s, 1)})
        else:
            for line in beginning:  # at the first call alone
                note(line)

    report = publish(config, settings, stop, on_progress=progress, truth_dir=arguments.truth, ports_dir=arguments.ports)
    true = f"; the truth is in {arguments.truth}" if arguments.truth else ""
    line = f"simulated {report.simulated_s:g} s of {report.machines} machines: {report.readings} readings{true}"
    say({"ended": dataclasses.asdict(report)}) if arguments.json else note(line)
    return 0


def _record(config: SimConfig, arguments: Namespace, stop: threading.Event) -> int:
    from sim.config import resolve
    from sim.recorder import record

    seconds = resolve(config).seconds
    with Display("machines drive", headless=arguments.json) as display:
        show = partial(display.show, total_s=seconds, what="recording")
        simulator = record(config, arguments.record, arguments.truth, on_progress=show, stop=stop)
    table = {"recorded": str(arguments.record), "machines": len(simulator.machines), "seconds": simulator.simulated_s}
    true = {"truth": str(arguments.truth)} if arguments.truth else {}
    line = f"{len(simulator.machines)} machines drove {simulator.simulated_s:g} s, recorded in {arguments.record}"
    say(table | true) if arguments.json else tell("; the truth is in ".join([line, *true.values()]))
    return 0


def _draw(config: SimConfig, arguments: Namespace) -> None:
    from sim.pictures.picture import draw  # only pictures need the renderer

    pictures = [str(path) for path in draw(config, arguments.picture)]
    say({"pictures": pictures}) if arguments.json else note("\n".join(pictures))


def _config(arguments: Namespace) -> SimConfig:
    from sim.config import SimConfig, load_sim

    config = load_sim(arguments.config) if arguments.config else SimConfig()
    over = {name: getattr(arguments, name) for name in OVER if getattr(arguments, name) is not None}
    if "machines" in over and over["machines"] != config.machines:
        over["names"] = None
    if arguments.all_sensors:
        over |= ALL_SENSORS
    if arguments.ports and not config.receivers:
        over.setdefault("receivers", "ubx")
    try:
        config = dataclasses.replace(config, **over)
        if config.receivers and not arguments.ports:
            raise ValueError("receivers: they speak on ports, so say where: --ports FOLDER")
        return config
    except ValueError as error:
        raise ConfigError("sitegrid sim", str(error)) from None
